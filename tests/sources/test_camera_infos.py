"""Which camera info an import takes: that of the images, and none of another camera."""

from dataclasses import replace

import pytest
from changed_sources import SMALL, changed

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io.dataset import open_dataset
from lvba.simulate import raw
from lvba.sources import camera_topics
from lvba.sources.camera_topics import CameraTopic
from lvba.sources.importing.importer import import_source
from lvba.sources.inspection import inspect
from lvba.sources.source import CameraInfo, RawImage, TransformSample

pytestmark = pytest.mark.usefixtures("one_pair")
ONE = Camera(width=640, height=480, fx=500, fy=500, cx=320, cy=240, distortion=(0.0,) * 4)
OTHER = replace(ONE, fx=400.0)


def source_with(truth, change):
    return changed(raw.written(truth, sensors=SMALL), change)


def taken(topics, image="/left/image_raw", frame="camera", **more):
    chosen = camera_topics.of_images([CameraTopic(*each) for each in topics], image, frame, **more)
    return None if chosen is None else chosen.name


@pytest.mark.parametrize("image", ["/left/image_raw", "/left/image_raw/compressed"])
def test_a_camera_info_beside_the_images_counts_more_than_one_of_the_same_frame(image):
    topics = [("/left/camera_info", "left", ONE), ("/right/camera_info", "camera", OTHER)]
    assert taken(topics, image) == "/left/camera_info"


@pytest.mark.parametrize("image", ["/rig/cam0", "/rig/cam0/compressed"])
def test_a_camera_info_may_lie_below_the_name_of_its_images(image):
    topics = [("/rig/cam0/camera_info", "", ONE), ("/rig/cam1/camera_info", "camera", OTHER)]
    assert taken(topics, image) == "/rig/cam0/camera_info"


def test_frames_tell_camera_infos_of_one_namespace_apart():
    topics = [("/left/camera_info", "depth", OTHER), ("/left/color_info", "camera", ONE)]
    assert taken(topics) == "/left/color_info"
    # where they tell nothing, the usual name does
    assert taken([(name, "camera", camera) for name, _, camera in topics]) == "/left/camera_info"
    assert taken([("/left/a", "camera", ONE), ("/left/b", "camera", OTHER)]) is None
    assert taken([("/left/a", "camera", ONE), ("/left/b", "camera", ONE)]) == "/left/a"


def test_the_nearest_namespace_around_the_images_is_taken():
    topics = [("/camera_info", "camera", OTHER), ("/rig/camera_info", "camera", ONE)]
    assert taken(topics, "/rig/left/image_raw") == "/rig/camera_info"
    assert taken([("/camera_info", "of the driver", OTHER)]) == "/camera_info"


def test_a_camera_info_elsewhere_must_have_the_frame_and_the_size():
    assert taken([("/depth/camera_info", "depth", OTHER)]) is None
    assert taken([("/driver/camera_info", "camera", ONE)]) == "/driver/camera_info"
    assert taken([("/driver/camera_info", "camera", ONE)], fits=lambda camera: False) is None
    assert taken([("/driver/camera_info", "", ONE)], frame="") is None
    assert taken([("/a/camera_info", "camera", ONE), ("/b/camera_info", "camera", OTHER)]) is None


def stereo(name, record):
    """Two cameras whose drivers say one frame; images of the left one."""
    if isinstance(record, CameraInfo):
        other = replace(record.camera, fx=0.7 * record.camera.fx)
        infos = {"/left/camera_info": record.camera, "/right/camera_info": other}
        return [(topic, replace(record, frame="camera", camera=camera)) for topic, camera in infos.items()]
    if isinstance(record, RawImage):
        return [("/left/image_raw", replace(record, frame="camera"))]
    if isinstance(record, TransformSample) and record.child == raw.CAMERA_FRAME:
        return [(name, replace(record, child="camera"))]
    return [(name, record)]


def test_the_camera_of_the_images_is_taken_where_another_has_their_frame(tmp_path, small_truth):
    source = source_with(small_truth, stereo)
    report = import_source(source, tmp_path / "out")
    assert open_dataset(tmp_path / "out").camera.fx == pytest.approx(small_truth.camera.fx)
    assert report.facts["calibration"]["camera"] == "camera info /left/camera_info"
    assert not any("no camera" in words for words in inspect(source).missing)


def test_the_only_camera_info_is_not_taken_where_it_is_of_another_camera(tmp_path, small_truth):
    def of_depth(name, record):
        other = isinstance(record, CameraInfo)
        return [("/depth/camera_info", replace(record, frame="depth")) if other else (name, record)]

    source = source_with(small_truth, of_depth)
    with pytest.raises(
        InputError, match=r"nothing says intrinsics of the camera \(not taken .*: /depth/camera_info\)"
    ):
        import_source(source, tmp_path / "out")
    assert any("no camera" in words for words in inspect(source).missing)


def test_a_camera_info_without_a_size_is_of_the_size_of_the_images(tmp_path, small_truth):
    def unsized(name, record):
        camera = replace(record.camera, width=0, height=0) if isinstance(record, CameraInfo) else None
        return [(name, record if camera is None else replace(record, camera=camera))]

    import_source(source_with(small_truth, unsized), tmp_path / "out")
    camera = open_dataset(tmp_path / "out").camera
    assert (camera.width, camera.height) == (SMALL.width, SMALL.height)
    assert camera.fx == pytest.approx(small_truth.camera.fx)

    def of_others(name, record):
        [(_, record)] = unsized(name, record)
        moved = isinstance(record, CameraInfo) and replace(record.camera, cx=3 * record.camera.cx)
        return [(name, replace(record, camera=moved) if moved else record)]

    with pytest.raises(InputError, match="principal point"):
        import_source(source_with(small_truth, of_others), tmp_path / "other")
