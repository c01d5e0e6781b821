"""Frames of a video: the sharpest of each part, none of parts that stand still, at the size that was asked for."""

import subprocess

import numpy as np
import pytest
from PIL import Image

from nerfvol.errors import InputError
from nerfvol.files.pictures import open_video
from nerfvol.poses import video as videos
from nerfvol.poses.video import Judged, choose_frames, is_high_range, judge_video, write_frames


def blurred(picture, times):
    for _ in range(times):
        picture = sum(np.roll(picture, s, a) for s in (-1, 0, 1) for a in (0, 1)) / 6
    return picture


def test_the_sharpest_of_each_part_and_none_where_nothing_moves():
    rng = np.random.default_rng(0)
    thumbnails = rng.integers(0, 255, (12, 5, 5)).astype(np.uint8)
    thumbnails[6:9] = thumbnails[5]
    judged = Judged(np.array([1, 3, 2, 1, 1, 9, 5, 6, 5, 4, 8, 7], np.float32), thumbnails)
    assert choose_frames(judged, 4) == [1, 5, 10]
    assert choose_frames(judged, 100) == [0, 1, 2, 3, 4, 5, 9, 10, 11]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """30 frames of a wide picture going by; every third is sharp, the others blurred."""
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    wide = blurred(np.random.default_rng(0).uniform(0, 1, (120, 400)), 2)
    wide = (wide - wide.min()) / np.ptp(wide)
    with open_video(path, 30) as writer:
        for i in range(30):
            frame = wide[:, 6 * i : 6 * i + 160]
            frame = frame if i % 3 == 1 else blurred(frame, 12)
            writer.add(np.repeat(frame[..., None], 3, 2).astype(np.float32))
    return path


def test_a_video_gives_its_sharp_frames(video, tmp_path):
    judged = judge_video(video)
    assert judged.sharpness.shape == (30,) and judged.thumbnails.shape[0] == 30
    chosen = choose_frames(judged, 10)
    assert chosen == list(range(1, 30, 3))
    names = write_frames(video, chosen, tmp_path / "images", 80)
    assert names[0] == "frame_00001.jpg" and len(list((tmp_path / "images").iterdir())) == 10
    with Image.open(tmp_path / "images" / names[3]) as image:
        assert image.size == (80, 60)


def test_more_than_a_hundred_frames_can_be_taken(tmp_path):
    """As `nerfvol capture` takes of a minute; frame k of this video is a grey of 20 + k."""
    path = tmp_path / "long.mp4"
    with open_video(path, 30) as writer:
        for k in range(125):
            writer.add(np.full((32, 32, 3), (20 + k) / 255, np.float32))
    chosen = [k for k in range(125) if k % 11]
    names = write_frames(path, chosen, tmp_path / "images", 32)
    assert len(names) == len(chosen) > 110
    for k in (1, 57, 124):
        with Image.open(tmp_path / "images" / f"frame_{k:05d}.jpg") as image:
            assert abs(float(np.asarray(image.convert("L")).mean()) - 20 - k) < 3


def test_what_does_not_decode_is_said(tmp_path):
    path = tmp_path / "broken.mp4"
    path.write_bytes(b"not a video at all" * 100)
    with pytest.raises(InputError, match="broken.mp4: expected a video, but it does not decode"):
        judge_video(path)


def test_a_video_in_the_middle_of_which_the_file_ends(video, tmp_path):
    """Cut after the index at its head, it gives the frames there are, or a sentence."""
    path = tmp_path / "cut.mp4"
    path.write_bytes(video.read_bytes()[: video.stat().st_size * 2 // 3])
    try:
        assert 1 <= len(judge_video(path).sharpness) < 30
    except InputError as error:
        assert "cut.mp4" in str(error)


COLOURS = np.array([[200, 100, 50], [60, 120, 200], [40, 160, 60], [120, 120, 120], [180, 60, 160]], np.uint8)
HIGH = (
    "scale=out_color_matrix=bt709:out_range=tv,format=yuv444p,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv,"
    "zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt2020,zscale=t={0}:npl=203:m=bt2020nc:r=tv,format=yuv420p10le"
)


def coloured(folder, filters, *tags):
    """A video of stripes of COLOURS, 32 pixels wide, with what the filters make of them and the colours that it states."""
    import imageio_ffmpeg

    Image.fromarray(COLOURS[None].repeat(64, 0).repeat(32, 1)).save(folder / "stripes.png")
    stated = [part for tag in zip(("-color_primaries", "-color_trc", "-colorspace"), tags, strict=True) for part in tag]
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-loglevel",
        "error",
        "-loop",
        "1",
        "-i",
        str(folder / "stripes.png"),
        "-t",
        "0.2",
    ]
    video = folder / "v.mp4"
    subprocess.run(
        [*command, "-t", "0.2", "-vf", filters, "-c:v", "libx264", "-crf", "4", *stated, str(video)], check=True
    )
    return video


def stripes(folder, video):
    """The colours in the middle of the stripes of the video's second frame, as it is written."""
    (name,) = write_frames(video, [1], folder / "images", 400)
    with Image.open(folder / "images" / name) as image:
        return np.asarray(image)[32, 16::32].astype(int)


@pytest.mark.parametrize("matrix", ["bt709", "smpte170m"])
def test_frames_have_the_videos_colours(tmp_path, matrix):
    """JPEG's numbers are BT.601's whatever the video's: taken over as they are, those of BT.709 are 20 levels off. What is
    left is 8 bits of two kinds of luma and chroma, and JPEG's own rounding."""
    video = coloured(tmp_path, f"scale=out_color_matrix={matrix}:out_range=tv,format=yuv420p", *[matrix] * 3)
    assert not is_high_range(video)
    assert np.abs(stripes(tmp_path, video) - COLOURS).max() <= 6


needs_zscale = pytest.mark.skipif(
    not videos.converts_high_range(), reason="an ffmpeg without zscale makes no HDR video"
)


@needs_zscale
@pytest.mark.parametrize("curve", ["arib-std-b67", "smpte2084"])
@pytest.mark.parametrize("others", ["bt2020", "unknown"])
def test_videos_of_a_high_range_are_no_paler_than_others(tmp_path, curve, others):
    """Bright colours are compressed by the mapping, to about a tenth less; taken as they are these are 60 levels off. Some
    programs state the curve alone."""
    matrix = others.replace("bt2020", "bt2020nc")
    filters = f"{HIGH.format(curve)},setparams=colorspace={matrix}:color_primaries={others}"
    video = coloured(tmp_path, filters, others, curve, matrix)
    assert is_high_range(video)
    assert np.abs(stripes(tmp_path, video) - COLOURS).max() <= 16


@needs_zscale
def test_an_ffmpeg_without_the_filter_gives_pale_frames(tmp_path, monkeypatch):
    video = coloured(tmp_path, HIGH.format("arib-std-b67"), "bt2020", "arib-std-b67", "bt2020nc")
    monkeypatch.setattr(videos, "converts_high_range", lambda: False)
    monkeypatch.setattr(videos, "_TO_ORDINARY_RANGE", ",nosuchfilter")
    assert stripes(tmp_path, video).shape == COLOURS.shape
