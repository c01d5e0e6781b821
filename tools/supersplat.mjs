// A picture of a file of splats in SuperSplat's viewer, in headless Chromium without a GPU (some ten seconds for 100,000 splats).
//
//   npm install @playcanvas/supersplat-viewer playwright-core     (and Chromium; CHROMIUM names it where it is elsewhere)
//   node supersplat.mjs scene.ply picture.png 400x400 EYE TARGET FOV     EYE and TARGET x,y,z in the viewer's axes, FOV in degrees
//
// The viewer turns a file by half a turn about z, y being up: what is (x, y, z) in the file is (-x, -y, z) there.
import fs from 'node:fs';
import http from 'node:http';
import path from 'node:path';
import { renderViewerHtml } from '@playcanvas/supersplat-viewer';
import { chromium } from 'playwright-core';

const [scene, picture, size, eye, target, fov] = process.argv.slice(2);
const [width, height] = size.split('x').map(Number);
const off = { enabled: false };
const settings = {
    version: 2,
    tonemapping: 'none',
    highPrecisionRendering: false,
    background: { color: [1, 1, 1] },
    postEffectSettings: {
        sharpness: { ...off, amount: 0 },
        bloom: { ...off, intensity: 0, blurLevel: 2 },
        grading: { ...off, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
        vignette: { ...off, intensity: 0, inner: 0, outer: 1, curvature: 1 },
        fringing: { ...off, intensity: 0 },
    },
    animTracks: [],
    annotations: [],
    cameras: [{ initial: { position: eye.split(',').map(Number), target: target.split(',').map(Number), fov: Number(fov) } }],
    startMode: 'default',
};
const name = path.basename(scene);
const html = renderViewerHtml({
    bootstrap: { settings, contentUrl: `./${name}` },
    inlineCss: true,
    inlineJs: true,
});
const server = http.createServer((request, response) => {
    const asked = path.basename(new URL(request.url, 'http://localhost').pathname);
    if (asked === name) return fs.createReadStream(scene).pipe(response);
    response.writeHead(asked ? 404 : 200, { 'Content-Type': 'text/html' }).end(asked ? '' : html);
});
await new Promise((done) => server.listen(0, '127.0.0.1', done));

const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
    args: ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'],
});
const page = await browser.newPage({ viewport: { width, height } });
page.on('pageerror', (error) => console.error(String(error)));
await page.addInitScript(() => { window.firstFrame = () => { window.wasDrawn = true; }; });
await page.goto(`http://127.0.0.1:${server.address().port}/?webgl&aa&noui&noanim&nofx`, { timeout: 300000 });
await page.waitForFunction(() => window.wasDrawn, null, { timeout: 300000 });
await page.waitForTimeout(3000);
await page.screenshot({ path: picture });
await browser.close();
server.close();
