"""A camera image by image: the backend that OpenCV stands for and the clock are the test's."""

import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hrc_learn.hardware import CameraError, CaptureCamera, opencv_cameras
from hrc_learn.hardware.opencv_cameras import taken_by

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

PATIENCE = 20.0
BGR = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)


class Backend:
    """A capture of OpenCV, and the clock: an image comes when the test lets it.

    Attributes:
        images: What comes next: an image with its position [ms], None for one that is broken.
        opened: Arguments of `cv2.VideoCapture`.
    """

    def __init__(self):
        self.now, self.opened, self.released, self.is_open = 50.0, [], 0, True
        self.images, self.news, self.grabbed = [(BGR, 0.0)], threading.Condition(), 0
        self.ended, self.current = False, None

    def VideoCapture(self, *arguments):
        self.opened.append(arguments)
        return self

    def isOpened(self):
        return self.is_open

    def monotonic(self):
        return self.now

    def grab(self):
        with self.news:
            self.grabbed += 1
            self.news.notify_all()
            assert self.news.wait_for(lambda: self.images or self.ended, PATIENCE)
            if not self.images:
                return False
            self.current = self.images.pop(0)
            return True

    def get(self, what):
        assert what == cv2.CAP_PROP_POS_MSEC
        return self.current[1]

    def retrieve(self):
        return self.current[0] is not None, self.current[0]

    def release(self):
        self.released += 1

    def show(self, image, position=0.0):
        """Let an image come, and wait until the next one is waited for."""
        with self.news:
            self.images.append((image, position))
            before = self.grabbed
            self.news.notify_all()
            assert self.news.wait_for(lambda: self.grabbed > before, PATIENCE)

    def end(self):
        with self.news:
            self.ended = True
            self.news.notify_all()


@pytest.fixture
def backend(monkeypatch):
    backend = Backend()
    monkeypatch.setattr(cv2, "VideoCapture", backend.VideoCapture)
    monkeypatch.setattr(opencv_cameras, "time", backend)
    yield backend
    backend.end()


@pytest.fixture
def camera(backend):
    camera = CaptureCamera(3, delay=0.25, timeout=0.5)
    yield camera
    backend.end()
    camera.close()


def test_devices_are_opened_by_number_or_path_and_files_as_they_are(backend, tmp_path):
    file = tmp_path / "7.mkv"
    file.write_bytes(b"")
    for source, opened in (
        (3, 3),
        ("12", 12),
        ("/dev/video3", "/dev/video3"),
        (file, str(file)),
    ):
        backend.images, backend.ended = [(BGR, 0.0)], False
        camera = CaptureCamera(source)
        assert backend.opened[-1] == (opened,)
        backend.end()
        camera.close()
    assert backend.released == 4


def test_a_stream_is_given_its_timeouts_in_milliseconds(backend):
    camera = CaptureCamera("rtsp://camera/1", timeout=0.75)
    backend.end()
    camera.close()
    ((source, api, options),) = backend.opened
    assert (source, api) == ("rtsp://camera/1", cv2.CAP_FFMPEG)
    assert dict(zip(options[::2], options[1::2], strict=True)) == {
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: 5750,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC: 750,
    }


@pytest.mark.parametrize(
    ("source", "hint"),
    [
        (3, "camera 3 cannot be opened: is it plugged in"),
        ("/dev/video3", "camera /dev/video3 cannot be opened: is it plugged in"),
        ("http://c/1", "camera http://c/1 cannot be opened: is its server running"),
        (__file__, f"video {__file__} cannot be opened: is it a video, and complete"),
    ],
)
def test_what_does_not_open_is_named_with_a_hint(backend, source, hint):
    backend.is_open = False
    with pytest.raises(CameraError) as raised:
        CaptureCamera(source)
    assert str(raised.value).startswith(hint)


def test_the_newest_image_is_rgb_with_its_age_until_it_is_too_old(backend, camera):
    np.testing.assert_array_equal(camera.read(), BGR[..., ::-1])
    assert camera.age == 0.25
    assert camera._thread.daemon  # a program that forgets to close it may end
    backend.show(BGR + 100)
    backend.show(BGR + 200)
    backend.now += 0.1
    image = camera.read()
    np.testing.assert_array_equal(image, (BGR + 200)[..., ::-1])
    assert image.flags.c_contiguous
    assert camera.age == pytest.approx(0.35)
    backend.now = 50.5  # exactly the timeout
    camera.read()
    assert camera.age == 0.75
    backend.now += 0.25
    text = r"camera 3 has sent no image for 0\.8 s \(timeout: 0\.5 s\): check its cable"
    with pytest.raises(CameraError, match=text):
        camera.read()
    backend.show(BGR)
    camera.read()
    assert camera.age == 0.25


def test_an_image_counts_from_the_stamp_of_the_driver_unless_it_is_broken(backend, camera):
    backend.now = 60.0
    backend.show(BGR, 59_900.0)
    camera.read()
    assert camera.age == pytest.approx(0.25 + 0.1)
    backend.now = 60.1
    backend.show(None, 60_100.0)
    camera.read()
    assert camera.age == pytest.approx(0.25 + 0.2)
    backend.now = 59.0  # images are never younger than they are
    camera.read()
    assert camera.age == 0.25


def test_a_camera_that_ends_says_so_once_its_last_image_is_too_old(backend, camera):
    backend.end()
    camera._thread.join(PATIENCE)
    camera.read()
    backend.now += 0.51
    with pytest.raises(CameraError, match="camera 3 has ended or does not answer: see that"):
        camera.read()
    camera.close()
    assert backend.released == 1
    with pytest.raises(CameraError, match="camera 3 has ended"):
        camera.read()


def test_a_closed_camera_has_to_be_opened_again(backend, camera):
    closing = threading.Thread(target=camera.close)
    closing.start()
    while not camera._closing:
        pass
    backend.images.append((BGR, 0.0))
    with backend.news:
        backend.news.notify_all()
    closing.join(PATIENCE)
    with pytest.raises(CameraError, match="camera 3 is closed: open it again"):
        camera.read()


def test_a_camera_that_ends_before_its_first_image_is_an_error_at_once(backend):
    backend.images, backend.ended = [], True
    with pytest.raises(CameraError, match="camera 3 has ended or does not answer"):
        CaptureCamera(3)
    assert backend.released == 1


def test_the_first_image_may_take_five_seconds_more(backend, monkeypatch):
    waited = []

    class Impatient(threading.Condition):
        def wait_for(self, reached, longest=None):
            waited.append((reached(), longest))
            return False

    monkeypatch.setattr(
        opencv_cameras,
        "threading",
        SimpleNamespace(Condition=Impatient, Thread=threading.Thread),
    )
    backend.images = []
    threading.Timer(0.02, backend.end).start()
    with pytest.raises(
        CameraError, match=r"no image for 5\.8 s \(timeout: 0\.75 s\)|has ended"
    ):
        CaptureCamera(3, timeout=0.75)
    assert waited[0][1] == 5.75


def test_a_file_begins_with_the_first_reading_and_keeps_its_rate(backend, monkeypatch):
    waits, waited = [], threading.Event()

    class Condition(threading.Condition):
        def wait_for(self, reached, longest=None):
            if longest is not None and threading.current_thread().name.startswith("video"):
                waits.append(longest)
                waited.set()
            return super().wait_for(reached, longest)

    standing = SimpleNamespace(Condition=Condition, Thread=threading.Thread)
    monkeypatch.setattr(opencv_cameras, "threading", standing)
    backend.images = [(BGR, 0.0), (BGR + 100, 40.0), (BGR + 200, 80.0)]
    camera = CaptureCamera(__file__, timeout=0.5)
    backend.now = 70.0  # nothing is late before the first reading
    np.testing.assert_array_equal(camera.read(), BGR[..., ::-1])
    assert camera.age == 0.0
    assert waited.wait(PATIENCE)
    backend.now = 70.1
    seen = set()
    while 200 not in seen:
        seen.add(int(camera.read()[0, 0, 2]))
    assert camera.age == pytest.approx(0.02)
    assert seen <= {0, 100, 200}
    assert waits == pytest.approx([0.04, 0.0])  # the third is overdue
    backend.end()
    camera.close()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4, 1), np.uint8),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4, 3), np.uint16),
        np.zeros((3, 4, 4, 3), np.uint8),
    ],
)
def test_images_of_another_kind_are_refused_with_their_shape(backend, image):
    backend.images, backend.ended = [(image, 0.0)], True
    with pytest.raises(CameraError) as raised:
        CaptureCamera(3)
    text = f"camera 3 sends images of shape {image.shape} and type {image.dtype}, and not of"
    assert str(raised.value).startswith(text)
    assert backend.released == 1


@pytest.mark.parametrize(
    ("keyword", "value", "refused"),
    [
        ("delay", 0.0, False),
        ("delay", -1e-9, True),
        ("delay", np.nan, True),
        ("timeout", 1e-9, False),
        ("timeout", 0.0, True),
        ("timeout", np.nan, True),
    ],
)
def test_times_that_make_no_sense_are_refused(backend, keyword, value, refused):
    backend.ended = True
    if not refused:
        CaptureCamera(3, **{keyword: value}).close()
        return
    with pytest.raises(ValueError, match=f"{keyword} must .* but is {value} s"):
        CaptureCamera(3, **{keyword: value})
    assert backend.opened == []


@pytest.mark.parametrize(
    ("position", "taken"), [(49_000.0, 50.0), (49_000.5, 49.0005), (50_000.0, 50.0)]
)
def test_a_stamp_counts_from_now_to_just_before_the_oldest(position, taken):
    capture = SimpleNamespace(get=lambda what: position)
    assert taken_by(capture, now=50.0, oldest=1.0) == pytest.approx(taken, abs=1e-12)
