"""A rasteriser of 3DGS PLY files that shares nothing with nerfvol: numpy alone, float64, from the papers.

Kerbl et al. 2023 (projection, low-pass of 0.3, 1/255, 0.99), Yu et al. 2024 (the opacity of "mip"). Brute force: every splat
against every pixel of its bounding box.
"""

import numpy as np


def read(path):
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().split("\n")
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names)).astype(np.float64)
    return {name: table[:, k] for k, name in enumerate(names)}, "comment SplatRenderMode: mip" in lines


def harmonics(d, degree):
    """Real spherical harmonics (n, K) as 3DGS orders and signs them."""
    x, y, z = d.T
    y0 = [np.full(len(d), 0.28209479177387814)]
    y1 = [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    y2 = [1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
          -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)]  # fmt: skip
    return np.stack([*y0, *(y1 if degree > 0 else []), *(y2 if degree > 1 else [])], 1)


def rasterise(path, c2w, focal, width, height, background, near=1e-3):
    c, mip = read(path)
    rest = sum(name.startswith("f_rest_") for name in c) // 3
    sh = np.stack([c[f"f_dc_{k}"] for k in range(3)], 1)[:, :, None]
    if rest:
        more = np.stack([c[f"f_rest_{k}"] for k in range(3 * rest)], 1).reshape(-1, 3, rest)
        sh = np.concatenate([sh, more], 2)
    mean = np.stack([c["x"], c["y"], c["z"]], 1)
    w, x, y, z = np.stack([c[f"rot_{k}"] for k in range(4)]) / np.sqrt(sum(c[f"rot_{k}"] ** 2 for k in range(4)))
    turn = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
                     1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
                     1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)  # fmt: skip
    space = turn * np.exp(np.stack([c[f"scale_{k}"] for k in range(3)], 1))[:, None]
    world = (c2w[:3, :3] * (1, -1, -1)).T
    t = (mean - c2w[:3, 3]) @ world.T
    o = 1 / (1 + np.exp(-c["opacity"]))
    image, passed = np.zeros((height, width, 3)), np.ones((height, width))
    for i in np.argsort(t[:, 2], kind="stable"):
        tx, ty, tz = t[i]
        if tz <= near:
            continue
        limit_x, limit_y = 0.65 * width / focal, 0.65 * height / focal  # 1.3 half-fields
        u, v = np.clip(tx / tz, -limit_x, limit_x), np.clip(ty / tz, -limit_y, limit_y)
        a = np.array([[focal, 0, -focal * u], [0, focal, -focal * v]]) / tz @ world @ space[i]
        flat = a @ a.T
        cov = flat + 0.3 * np.eye(2)
        rho = max(np.sqrt(max(np.linalg.det(flat), 0) / np.linalg.det(cov)), 0.005) if mip else 1.0
        if o[i] * rho <= 1 / 255:
            continue
        px, py = focal * tx / tz + width / 2, focal * ty / tz + height / 2
        reach = np.sqrt(2 * np.log(255 * o[i] * rho) * np.diag(cov)) + 1
        x0, x1 = max(int(px - reach[0]), 0), min(int(px + reach[0]) + 2, width)
        y0, y1 = max(int(py - reach[1]), 0), min(int(py + reach[1]) + 2, height)
        if x0 >= x1 or y0 >= y1:
            continue
        dx, dy = np.meshgrid(np.arange(x0, x1) + 0.5 - px, np.arange(y0, y1) + 0.5 - py)
        inverse = np.linalg.inv(cov)
        power = inverse[0, 0] * dx * dx + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy * dy
        alpha = np.minimum(o[i] * rho * np.exp(-0.5 * power), 0.99)
        alpha[alpha < 1 / 255] = 0
        d = (mean[i] - c2w[:3, 3]) / np.linalg.norm(mean[i] - c2w[:3, 3])
        colour = np.maximum(0.5 + sh[i] @ harmonics(d[None], int(np.sqrt(rest + 1)) - 1)[0], 0)
        share = passed[y0:y1, x0:x1] * alpha
        image[y0:y1, x0:x1] += share[..., None] * colour
        passed[y0:y1, x0:x1] *= 1 - alpha
    return image + passed[..., None] * np.asarray(background)
