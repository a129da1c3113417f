"""The number of lens parameters that are freed, on synthetic matches from a known camera."""

import json

import pytest

from sfm.engine_check import printed

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("colmap")]

SCENE = """
import json
from engine import lenses

def scene(name, params, frames, points=400, noise=0.5, seed=0):
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, frames
    options.num_points3D, options.track_length = points, -1
    options.camera_width, options.camera_height = 1000, 750
    options.camera_model_id = getattr(pycolmap.CameraModelId, name)
    options.camera_params = params
    options.sensor_from_rig_translation_stddev = options.sensor_from_rig_rotation_stddev = 0.0
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(seed)
    for number in model.reg_image_ids():
        for point in model.image(number).points2D:
            point.xy = point.xy + rng.normal(0, noise, 2)
    return model

def mapped(model):
    # The state after mapping: adjusted with one focal length and one distortion coefficient.
    for number in list(model.cameras):
        camera = model.camera(number)
        focal = 1.03 * camera.focal_length_x
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [focal, 500, 375, 0.0]
    lenses.adjust(model, 1)
    return model

def found(model):
    refined, names = lenses.refined(mapped(model), True, 1)
    (number,) = names
    camera = refined.camera(number)
    print(json.dumps([names[number], camera.focal_length_x, camera.focal_length_y,
                      camera.principal_point_x, camera.principal_point_y]))
"""


def outcome(script):
    return [json.loads(line) for line in printed(SCENE + script)]


def test_few_photos_keep_one_focal_length_and_a_centred_principal_point():
    script = """
found(scene("SIMPLE_RADIAL", [815, 500, 375, 0.02], 12))
found(scene("SIMPLE_RADIAL", [815, 500, 375, 0.02], 24))
"""
    for lens, fx, fy, cx, cy in outcome(script):
        assert lens == "SIMPLE_RADIAL" and (cx, cy) == (500, 375)
        # Half a pixel of noise on a few thousand observations leaves an error of the focal length well below 1 %.
        assert fx == fy and fx == pytest.approx(815, rel=0.01)


def test_distortion_is_added_if_enough_photos_show_it():
    script = """
crooked = [815, 815, 500, 375, -0.2, 0.12, 0.02, -0.03]
found(scene("OPENCV", crooked, 24, points=800, noise=0.1))
found(scene("OPENCV", crooked, 12, points=800, noise=0.1))
"""
    many, few = outcome(script)
    assert many[0].startswith("OPENCV")
    assert many[1:3] == pytest.approx([815, 815], rel=0.01)
    assert few[0] == "SIMPLE_RADIAL", "six photos per half are too few to judge distortion"


def test_an_off_centre_principal_point_is_freed():
    (found,) = outcome('found(scene("SIMPLE_RADIAL", [815, 560, 350, 0.02], 30))')
    lens, fx, fy, cx, cy = found
    assert lens == "OPENCV, free centre"
    assert (fx, fy, cx, cy) == pytest.approx((815, 815, 560, 350), abs=8)


def test_a_lens_freed_during_mapping_is_simplified_and_judged_again():
    """Mapping with a free lens has fitted fx, fy and distortion to the noise."""
    script = """
def free(model, params):
    for number in list(model.cameras):
        model.camera(number).model = pycolmap.CameraModelId.OPENCV
        model.camera(number).params = params
    lenses.adjust(model, 1)
    lenses.simplified(model, "SIMPLE_RADIAL", 1)
    refined, names = lenses.refined(model, True, 1)
    (number,) = names
    camera = refined.camera(number)
    print(json.dumps([names[number], camera.focal_length_x, camera.focal_length_y, list(camera.params[-4:])]))

free(scene("SIMPLE_RADIAL", [815, 500, 375, 0.02], 12), [845, 859, 516, 370, 0.05, -0.1, 0.01, -0.01])
crooked = [815, 815, 500, 375, -0.2, 0.12, 0.02, -0.03]
free(scene("OPENCV", crooked, 20, points=500, noise=0.1), [*crooked[:4], -0.19, 0.1, 0.01, -0.02])
"""
    plain, crooked = outcome(script)
    assert plain[0] == "SIMPLE_RADIAL" and plain[1] == plain[2] == pytest.approx(815, rel=0.01)
    assert crooked[0].startswith("OPENCV") and crooked[1:3] == pytest.approx([815, 815], rel=0.01)
    k1, _, p1, p2 = crooked[3]  # k2 matters only in the corners
    assert (k1, p1, p2) == pytest.approx((-0.2, 0.02, -0.03), abs=0.02)
