"""The kit can fail: a renderer with one broken convention is caught by the case that names it, even in float32.

The renderer is tests/simple_renderer.py, written from the specification and independent of the package; unbroken, it
passes in float64.
"""

import dataclasses

import numpy as np
import pytest
from safetensors.numpy import save_file

import run
from simple_lens import LensConventions
from simple_renderer import Conventions, SimpleRenderer

OUTPUT_BREAKS = {
    "pixel centres at halves": ("one_gaussian", {"pixel_offset": 0.5}),
    "rows and columns exchanged": ("one_gaussian", {"axes_swapped": True}),
    "no cut-off": ("one_gaussian", {"alpha_min": 0.0}),
    "quaternions as (x, y, z, w)": ("quaternions", {"quaternion": (3, 0, 1, 2)}),
    "quaternions not normalised": ("quaternions", {"normalised": False}),
    "inverse rotations": ("quaternions", {"transposed": True}),
    "harmonics without signs": ("each_harmonic", {"sh_signs": False}),
    "degree 1 in the order x, y, z": ("each_harmonic", {"sh_order": (0, 3, 1, 2, *range(4, 16))}),
    "no offset of colours": ("each_harmonic", {"sh_offset": 0.0}),
    "directions to the camera": ("each_harmonic", {"toward_camera": True}),
    "degree 3 despite the setting": ("sh_degree_1_of_3", {"sh_degree": 3}),
    "negative colours": ("negative_colours", {"sh_floor": False}),
    "colours clipped at 1": ("negative_colours", {"sh_ceiling": 1.0}),
    "dilation of 0.25": ("smaller_than_a_pixel", {"dilation": 0.25}),
    "no antialiasing": ("antialiased", {"compensates": False}),
    "antialiasing without the root": ("antialiased", {"compensation_power": 1.0}),
    "alpha clamped at 0.999": ("alpha_clamp", {"alpha_max": 0.999}),
    "alpha not clamped": ("alpha_clamp", {"alpha_max": 1.0}),
    "alpha clamped at 0.99 despite the setting": ("clamp_at_0.999", {"alpha_max": 0.99}),
    "cut-off at 1/510": ("nearly_transparent", {"alpha_min": 1 / 510}),
    "cut-off at 1/254": ("nearly_transparent", {"alpha_min": 1 / 254}),
    "order of the input": ("random", {"order": "input"}),
    "order by distance": ("random", {"order": "distance"}),
    "no background": ("random", {"background": 0.0}),
    "features over one": ("random", {"features_over": 1.0}),
    "depth as distance": ("random", {"depth": "distance"}),
    "depth divided by alpha": ("random", {"depth": "divided by alpha"}),
    "median where T falls below 0.4": ("random", {"median_below": 0.4}),
    "ties in reverse": ("ties_in_depth", {"ties": "last"}),
    "dilation of 0.3 px, not px²": ("needles", {"dilation": 0.09}),
    "ellipses cut at 3 standard deviations": ("alpha_clamp", {"largest_distance": 3.0}),
    "Gaussians above 12 px dropped": ("larger_than_the_image", {"largest_deviation": 12.0}),
    "means outside the image dropped": ("off_screen_centres", {"drops_means_outside": True}),
    "no clamp of the Jacobian": ("off_screen_centres", {"clamps_jacobian": False}),
    "clamp about the principal point": ("off_screen_centres", {"clamp_centre": "principal point"}),
    "clamp of the Jacobian despite the setting": ("off_screen_unclamped", {"limit": 1.3}),
    "z_near of 0.2 despite the setting": ("z_near", {"z_near": 0.2}),
    "z_near included": ("z_near", {"near_included": True}),
    "behind the camera drawn": ("nothing_in_view", {"z_near": -100.0}),
    "stops before the last visible Gaussian": ("opaque_tiles_stop", {"stop": "before"}),
    "stops at 0.001": ("opaque_tiles_stop", {"stop": "before", "stop_at": 1e-3}),
    "at most 128 layers": ("hundreds_of_layers", {"most_layers": 128}),
    "rows and columns exchanged, tall image": ("odd_size", {"axes_swapped": True}),
    "pixel centre of the only pixel at a half": ("one_pixel", {"pixel_offset": 0.5}),
    "empty scenes refused": ("no_gaussians", {"refuses_empty": True}),
    "antialiasing ignored behind a lens": ("lens_antialiased", {"compensates": False}),
}
"""Broken conventions by name: the case that has to catch it, and the change of the renderer."""

LENS_BREAKS = {
    "distortion ignored": ("lens_opencv", {"distorts": False}),
    "prism terms of u and v exchanged": ("lens_prism", {"prism": (13, 14, 11, 12)}),
    "prism terms of the two powers exchanged": ("lens_prism", {"prism": (12, 11, 14, 13)}),
    "means beyond the end of a lens drawn": ("lens_ends", {"lens_ends": False}),
    "a fisheye blind past 90 degrees": ("lens_fisheye", {"behind": False}),
    "order and depth of a fisheye by z": ("lens_fisheye", {"depth": "z"}),
    "radial_first ignored": ("lens_radial_first", {"radial_first": False}),
    "order and depth of a panorama by z": ("lens_panorama", {"depth": "z"}),
    "no seam": ("lens_seam", {"periodic": False}),
    "directions of an orthographic camera from its centre": ("lens_orthographic", {"parallel": False}),
    "first row at time 0": ("shutter_down", {"first_time": 0.0}),
    "last row at time 1": ("shutter_down", {"first_time": 0.0, "rows": -1}),
    "rows read from the top": ("shutter_up", {"reverses": False}),
    "rows read instead of columns": ("shutter_left", {"columns": False}),
    "no shear": ("shutter_right", {"shears": False}),
    "turn without shift": ("shutter_panorama", {"shifts": False}),
    "no motion blur": ("blur_global", {"blurs": False}),
    "blur of a fixed row": ("blur_down", {"follows": False}),
    "opacities of blurred splats kept": ("blur_global", {"blur_factor": 0.0}),
    "bounds of an undistorted image": ("lens_clamp", {"edges_distorted": False}),
    "no clamp behind a lens": ("lens_clamp", {"clamps": False}),
    "no clamp behind a shutter": ("shutter_clamp", {"clamps": False}),
}
"""The same of lenses and shutters."""

OUTPUT_BREAKS |= {
    name: (case, {"lens": LensConventions(**changes)}) for name, (case, changes) in LENS_BREAKS.items()
}

GRADIENT_BREAKS = {
    "direction detached": ("gradient_smooth", {"direction_detached": True}),
    "Jacobian detached": ("gradient_smooth", {"jacobian_detached": True}),
    "length of quaternions detached": ("gradient_smooth", {"length_detached": True}),
    "transmittance detached": ("gradient_smooth", {"transmittance_detached": True}),
    "compensation detached": ("gradient_antialiased", {"compensation_detached": True}),
    "gradient passes the clamp of the Jacobian": ("gradient_jacobian_clamp", {"jacobian_passes": True}),
    "gradient passes the clamp of alpha": ("gradient_alpha_clamp", {"clamp_passes": True}),
    "gradient passes the floor of colours": ("gradient_colour_floor", {"floor_passes": True}),
    "gradient passes the cut-off": ("gradient_random", {"cut_passes": True}),
    "Jacobian of a lens detached": ("gradient_lens_opencv", {"lens_jacobian_detached": True}),
    "Jacobian of a fisheye detached": ("gradient_lens_fisheye", {"lens_jacobian_detached": True}),
    "direction in a panorama detached": ("gradient_lens_panorama", {"direction_detached": True}),
    "direction of an orthographic camera detached": (
        "gradient_lens_orthographic",
        {"direction_detached": True},
    ),
    "time of a mean detached": ("gradient_shutter", {"lens": LensConventions(time_detached=True)}),
    "motion blur detached": ("gradient_blur", {"lens": LensConventions(blur_detached=True)}),
}
"""Broken gradients by name, which leave every output unchanged."""


def checked(names, **changes):
    renderer = SimpleRenderer(Conventions(**changes))
    cases = run.load_cases(names)
    return run.check(renderer.render, renderer.gradients, precision="float32", cases=cases)


def test_a_renderer_written_from_the_specification_passes():
    renderer = SimpleRenderer()
    report = run.check(renderer.render, renderer.gradients)
    assert report.passed, str(report)
    assert not report.left_out
    assert {row.case for row in report.rows} == {case.name for case in run.load_cases()}


@pytest.mark.parametrize("broken", OUTPUT_BREAKS)
def test_a_broken_convention_is_caught(broken):
    name, changes = OUTPUT_BREAKS[broken]
    report = checked([name], **changes)
    assert report.failed_cases == (name,)
    assert report.hints[name] in str(report)


@pytest.mark.parametrize("broken", GRADIENT_BREAKS)
def test_a_broken_gradient_is_caught_although_the_image_is_right(broken):
    name, changes = GRADIENT_BREAKS[broken]
    report = checked([name], **changes)
    assert report.failed_cases == (name,)
    assert all(row.what.startswith("d/d") for row in report.failures)


WRONG_RESULTS = {
    "gradient_32_features": lambda found: found | {"features": found["features"] * (np.arange(32) < 16)},
    "gradient_sh_degree_1": lambda found: found | {"sh": found["sh"] + 1e-3},
    "gradient_needles": lambda found: found | {"quats": found["quats"].astype(np.float16)},
}
"""Errors in correct gradients, for the cases that no broken convention alone makes fail."""


@pytest.mark.parametrize("name", WRONG_RESULTS)
def test_a_wrong_gradient_is_caught(name):
    renderer = SimpleRenderer()
    change = lambda *given: WRONG_RESULTS[name](renderer.gradients(*given))  # noqa: E731
    cases = run.load_cases([name])
    assert run.check(renderer.render, renderer.gradients, cases=cases, precision="float32").passed
    assert not run.check(renderer.render, change, cases=cases, precision="float32").passed


def test_every_case_catches_something():
    caught = {name for name, _ in (OUTPUT_BREAKS | GRADIENT_BREAKS).values()} | set(WRONG_RESULTS)
    assert caught == {case.name for case in run.load_cases()}


@pytest.mark.parametrize("name", [*run.OUTPUTS, *(f"gradient.{name}" for name in run.GRADIENTS)])
def test_every_compared_array_can_fail(name):
    """An array that is off by twice its tolerance fails, and no other array does."""
    of_lens = name.rpartition(".")[2] in ("distortion", "turn", "shift")
    (case,) = run.load_cases(["gradient_shutter" if of_lens else "gradient_smooth"])
    renderer = SimpleRenderer()
    prefix, _, array = name.rpartition(".")

    def off(found):
        return found | {array: found[array] + 2 * run.tolerance(case, name, "float32")}

    render = renderer.render if prefix else (lambda *given: off(renderer.render(*given)))
    gradients = (lambda *given: off(renderer.gradients(*given))) if prefix else renderer.gradients
    report = run.check(render, gradients, precision="float32", cases=[case])
    (row,) = report.failures
    assert row.what == (f"d/d {array}" if prefix else array) and np.isfinite(row.error)
    assert run.check(render, gradients, precision="float32", cases=[case], without=[name]).passed


@pytest.mark.parametrize(
    ("result", "says"),
    [
        (lambda truth: truth * np.nan, "has NaN or infinite values"),
        (lambda truth: truth[:-1], "has shape (19, 24, 3), expected (20, 24, 3)"),
        (lambda truth: None, "is missing"),
    ],
)
def test_an_array_that_cannot_be_compared_fails_with_a_reason(result, says):
    cases = run.load_cases(["random"])
    renderer = SimpleRenderer()

    def render(*given):
        found = renderer.render(*given)
        return found | {"image": result(found["image"])}

    (row,) = run.check(render, cases=cases).failures
    assert row.what == "image" and row.note == says


def test_a_renderer_that_raises_fails_that_case_only():
    report = run.check(SimpleRenderer(Conventions(refuses_empty=True)).render)
    assert report.failed_cases == ("no_gaussians",)
    assert report.failures[0].note == "ValueError: no Gaussians"
    assert report.left_out == ("all gradients",)


def test_a_renderer_that_writes_into_its_inputs_cannot_change_the_case():
    cases = run.load_cases(["random"])
    before = cases[0].gaussians["means"].copy()

    def render(gaussians, camera, settings):
        found = SimpleRenderer().render(gaussians, camera, settings)
        gaussians["means"][:] = 0.0
        return found

    assert run.check(render, cases=cases).passed
    np.testing.assert_array_equal(cases[0].gaussians["means"], before)


def test_a_lens_that_the_renderer_lacks_is_named():
    """Its cases do not count as passed: they are listed by name, with what they need."""
    cases = run.load_cases(["random", "lens_fisheye", "shutter_down"])
    report = run.check(SimpleRenderer().render, cases=cases, without=["lens.fisheye", "lens.distortion"])
    assert report.passed and report.skipped == {"lens_fisheye": ("distortion", "fisheye")}
    assert {row.case for row in report.rows} == {"random", "shutter_down"}
    assert "2 of 2 cases pass" in str(report)
    assert "1 cases not run, of lenses that the renderer lacks: lens_fisheye (distortion, fisheye)." in str(
        report
    )
    everything = run.check(SimpleRenderer().render, without=["lens"])
    assert set(everything.skipped) == {case.name for case in run.load_cases() if case.needs}
    assert not run.check(SimpleRenderer().render, cases=cases[1:2], without=["lens"]).passed


def test_a_renderer_that_ignores_lens_and_shutter_fails_every_case_of_them():
    def render(gaussians, camera, settings):
        return SimpleRenderer().render(gaussians, camera | run.PINHOLE, settings)

    report = run.check(render, precision="float32")
    assert set(report.failed_cases) == {case.name for case in run.load_cases() if case.needs}


def test_every_lens_and_readout_has_a_case():
    cases = run.load_cases()
    assert {lens for case in cases for lens in case.needs} == set(run.LENSES)
    assert {case.camera["readout"] for case in cases} == {"none", "down", "up", "left", "right"}


def test_a_check_without_cases_does_not_pass():
    assert not run.check(SimpleRenderer().render, cases=[]).passed


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="does not know 'depht'"):
        run.check(SimpleRenderer().render, without=["depht"])
    with pytest.raises(ValueError, match="precision: is 'half'"):
        run.check(SimpleRenderer().render, precision="half")
    with pytest.raises(KeyError):
        run.load_cases(["no such case"])


def test_only_pixels_that_may_stop_early_have_the_tolerance_of_the_stop():
    """Pixels whose transmittance stays at 1e-4 or above have the usual tolerance."""
    (case,) = run.load_cases(["opaque_tiles_stop"])
    stopped = case.truth["transmittance"] < run.T_STOP
    assert stopped.any() and not stopped.all()
    allowed = run.tolerance(case, "image", "float64")
    assert allowed[stopped].min() >= 1e-4 and allowed[~stopped].max() < 1e-10
    unstopped = dataclasses.replace(case, stopped={})
    assert run.tolerance(unstopped, "image", "float64").max() < 1e-10


def test_the_command_line(capsys):
    arguments = ["simple_renderer_instance:render", "--case", "random"]
    assert run.main(arguments) == 2
    assert "simple_renderer_instance" in capsys.readouterr().err
    arguments = ["ours:render_torch", "ours:gradients_torch", "--case", "gradient_smooth"]
    assert run.main(arguments) == 0
    out = capsys.readouterr().out
    assert "1 of 1 cases pass, 19 arrays compared." in out
    assert run.main(["ours:render_torch", "--case", "random", "--without", "median_depth,features"]) == 0
    assert "Left out: features, median_depth, all gradients." in capsys.readouterr().out


def test_a_failure_exits_with_1(capsys, tmp_path, monkeypatch):
    """The stored truth of a case is changed, so the case fails."""
    path = next(run.CASES.glob("one_pixel.safetensors"))
    with run.safe_open(path, framework="numpy") as file:
        arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        metadata = file.metadata()
    arrays["truth.depth"] += 1e-9
    save_file(arrays, tmp_path / "one_pixel.safetensors", metadata=metadata)
    cases = run.load_cases(folder=tmp_path)
    monkeypatch.setattr(run, "load_cases", lambda names: cases)
    assert run.main(["ours:render_torch"]) == 1
    assert "one_pixel failed." in capsys.readouterr().out
