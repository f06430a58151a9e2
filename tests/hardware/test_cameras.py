"""Cameras that OpenCV and LeRobot open: files of known content, and streams over loopback."""

import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from hrc_learn.hardware import CameraError, CaptureCamera
from hrc_learn.hardware.opencv_cameras import taken_by
from hrc_learn.protocols import Camera, TimedCamera

RATE = 20.0


def picture(number, width=64, height=48):
    """Of one colour, RGB: red counts, green is there, blue is not."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0], image[..., 1] = 10 * (number % 20), 200
    return image


def number_of(image):
    assert image[..., 1].mean() == pytest.approx(200, abs=8)
    assert image[..., 2].mean() < 16  # the order of colours
    return round(float(image[..., 0].mean()) / 10)


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "twelve.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), RATE, (64, 48))
    assert writer.isOpened()
    for k in range(12):
        writer.write(picture(k)[..., ::-1])
    writer.release()
    return path


def test_a_file_plays_at_its_own_rate(video):
    with CaptureCamera(video, timeout=0.3) as camera:
        assert isinstance(camera, TimedCamera)
        time.sleep(0.2)  # it begins with the first reading
        before, seen = time.monotonic(), set()
        assert number_of(camera.read()) == 0
        begun = before - camera.age  # of the reading: not later than that, if it is held up

        def play():
            for _ in range(2000):
                number = number_of(camera.read())
                seen.add(number)
                # Held up after the reading, this thread sees a later time.
                taken = time.monotonic() - camera.age - begun
                assert number / RATE - 2e-3 <= taken < number / RATE + 0.2
                time.sleep(0.01)

        with pytest.raises(CameraError, match=r"twelve\.mkv has ended"):
            play()
        assert max(seen) == 11
        assert len(seen) > 3


def test_a_file_that_is_none_is_refused(tmp_path, video):
    with pytest.raises(FileNotFoundError, match="no video file"):
        CaptureCamera(tmp_path / "nothing.mp4")
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    with pytest.raises(CameraError, match=r"text\.mp4 cannot be opened: is it a video"):
        CaptureCamera(text)


@pytest.mark.parametrize("source", [97, "97", "/dev/video97"])
def test_a_device_that_is_not_there_is_named(source):
    with pytest.raises(CameraError, match=r"camera .*97 cannot be opened.*group video"):
        CaptureCamera(source)


class Stream:
    """An HTTP server of MJPEG, of pictures numbered by the time since it began."""

    def __init__(self, host="127.0.3.1"):
        self.size, self.silent, self.number = (64, 48), threading.Event(), 0
        stream = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=cut")
                self.end_headers()
                try:
                    while not stream.silent.is_set():
                        self.wfile.write(stream.part())
                        time.sleep(1 / 50)
                    stream.over.wait(20)  # the connection stays, nothing comes
                except OSError:
                    pass  # the camera was closed

            def log_message(self, format, *args):
                pass

        self.over = threading.Event()
        self._server = ThreadingHTTPServer((host, 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://{host}:{self._server.server_port}/stream.mjpg"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def part(self):
        self.number = (self.number + 1) % 20
        _, jpeg = cv2.imencode(".jpg", picture(self.number, *self.size)[..., ::-1])
        head = f"--cut\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
        return head.encode() + jpeg.tobytes() + b"\r\n"

    def close(self):
        self.silent.set()
        self.over.set()
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def stream():
    stream = Stream()
    yield stream
    stream.close()


def until(holds, longest=20.0):
    """Wait for something; it counts that it happens, not when."""
    end = time.monotonic() + longest
    while time.monotonic() < end:
        if holds():
            return True
        time.sleep(0.01)
    return False


def test_a_stream_gives_its_newest_image(stream):
    with CaptureCamera(stream.url, delay=0.25, timeout=5.0) as camera:
        assert isinstance(camera, Camera)
        first = number_of(camera.read())
        assert camera.age >= 0.25
        # Nobody reads for some images: the next reading is none of those kept back.
        seen = set()
        assert until(lambda: seen.add(number_of(camera.read())) or len(seen) >= 5)
        before = stream.number
        assert until(lambda: (stream.number - before) % 20 >= 6)
        late = (stream.number - number_of(camera.read())) % 20
        assert late <= 5, (first, late)


def test_a_stream_that_falls_silent_is_told(stream):
    with CaptureCamera(stream.url, timeout=0.4) as camera:
        stream.silent.set()

        def fails():
            try:
                camera.read()
            except CameraError as error:
                return stream.url in str(error)
            return False

        assert until(fails)


def test_a_server_that_is_not_there_is_told():
    with pytest.raises(CameraError, match="is its server running"):
        CaptureCamera("http://127.0.3.1:9/stream.mjpg", timeout=1.0)


class Grabbed:
    def __init__(self, milliseconds):
        self._position = milliseconds

    def get(self, what):
        assert what == cv2.CAP_PROP_POS_MSEC
        return self._position


@pytest.mark.parametrize(
    ("position", "taken"),
    [(49_970.0, 49.97), (50_000.0, 50.0), (0.0, 50.0), (1_200.0, 50.0), (50_100.0, 50.0)],
)
def test_the_stamp_of_a_driver_counts_if_it_is_one(position, taken):
    """Just before now; not the time since a stream began, nor one to come."""
    assert taken_by(Grabbed(position), now=50.0, oldest=1.0) == pytest.approx(taken)


@pytest.mark.parametrize("keyword", [{"delay": -0.1}, {"timeout": 0.0}])
def test_times_that_make_no_sense_are_refused(keyword, stream):
    with pytest.raises(ValueError, match=next(iter(keyword))):
        CaptureCamera(stream.url, **keyword)
