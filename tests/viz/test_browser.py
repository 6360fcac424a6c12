"""A video of a run plays in a browser."""

import cv2
import numpy as np
from browser import open_page

from torchtrack.viz import OverlayWriter


def test_a_video_plays_in_a_browser(tmp_path):
    with OverlayWriter(tmp_path / "overlay.mp4", frames_per_second=30.0, slow_motion=1.0, stills=0) as writer:
        for number in range(10):
            writer.add(number * 33_334, np.full((96, 128, 3), (0, 0, 255) if number < 5 else (0, 255, 0), np.uint8))
    (tmp_path / "page.html").write_text('<video src="overlay.mp4" muted></video><canvas width=128 height=96></canvas>')
    with open_page() as page:
        page.goto((tmp_path / "page.html").as_uri())
        facts = page.evaluate(
            """async () => {
                const video = document.querySelector("video");
                await video.play();
                await new Promise((done) => video.addEventListener("ended", done));
                return [video.error, video.videoWidth, video.videoHeight, video.duration, video.getVideoPlaybackQuality().totalVideoFrames];
            }"""
        )
        page.locator("video").screenshot(path=tmp_path / "last.png")
    assert facts[:3] == [None, 128, 96]
    assert 0.3 < facts[3] < 0.4 and facts[4] >= 1

    blue, green, red = cv2.imread(str(tmp_path / "last.png"))[48, 64]
    assert green > 200 and red < 60 and blue < 60
