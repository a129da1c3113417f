"""The native module refuses wrong arguments from any caller and names the argument."""

import numpy as np
import pytest
import torch

from gsplat_edu import _native
from gsplat_edu.ops import kernels
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.render.api import render
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import orbit_camera
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.optimizer import Adam

N, H, W = 5, 6, 7
RAW = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")


def parameters(dtype=torch.float32):
    return random_ball(N, torch.Generator().manual_seed(0), dtype).tensors()


def camera(**changes):
    fields = {"R": np.eye(3), "eye": np.array([0.0, 0.0, -3.0]), "fx": 9.0, "fy": 9.0, "cx": 3.0, "cy": 3.0}
    fields |= {"x_bounds": (-9.0, 9.0), "y_bounds": (-float("inf"), float("inf")), "H": H, "W": W}
    return _native.Camera(**fields | changes)


def settings(**changes):
    fields = {
        "z_near": 0.05,
        "background": [0.0, 0.0, 0.0],
        "sh_degree": 0,
        "antialiased": False,
        "dilation": 0.3,
        "alpha_max": 0.99,
        "pixel_stop": False,
    }
    return _native.Settings(**fields | changes)


def scene(**changes):
    return _native.Scene(**parameters() | changes)


def images(**changes):
    fields = {"image": torch.empty(H, W, 3), "transmittance": torch.empty(H, W), "depth": None}
    fields |= {"features": None, "median": None}
    return _native.Images(**fields | changes)


def gradients(**changes):
    extra = {"means2d_norm": torch.empty(N), "background": torch.empty(3), "camera": None, "features": None}
    return _native.Gradients(**parameters() | extra | changes)


def statistics(**changes):
    return _native.Statistics(**{"values": torch.empty(N, 6), "errors": None} | changes)


def frame(**changes):
    fields = {"scene": scene(), "camera": camera(), "settings": settings(), "needed": None, "threads": 2}
    return _native.FrameF32(**fields | changes)


def visible(**changes):
    drawn = frame()
    count = drawn.num_visible
    assert count == N
    drawn.visible(**{"ids": torch.empty(count, dtype=torch.int64), "radii": torch.empty(count, 2)} | changes)


def backward(**changes):
    drawn, out = frame(), images()
    drawn.composite(images=out, features=None)
    fields = {"scene": scene(), "images": out, "incoming": images(), "gradients": gradients()}
    fields |= {"features": None, "collected": None}
    drawn.backward(**fields | changes)


def adam(**changes):
    fields = {name: torch.zeros(N, 3) for name in ("parameter", "first", "second", "gradient")}
    fields |= dict.fromkeys(("rate", "beta1", "beta2", "eps", "correction1", "correction2"), 0.5)
    _native.adam_f32(**fields | {"threads": 2} | changes)


def adam_group(**changes):
    fields = {name: torch.zeros(N, 3) for name in ("parameter", "first", "second", "extra")}
    fields |= dict.fromkeys(("rate", "beta1", "beta2", "eps", "correction1", "correction2"), 0.5)
    return _native.AdamGroup(**fields | changes)


def groups(dtype=torch.float32):
    made = {}
    for name, tensor in parameters(dtype).items():
        moments = {part: torch.zeros_like(tensor) for part in ("first", "second")}
        made[name] = adam_group(parameter=tensor, extra=None, **moments)
    return made


def adam_backward(**changes):
    drawn, out = frame(), images()
    drawn.composite(images=out, features=None)
    fields = {
        "images": out,
        "incoming": images(),
        "means2d_norm": torch.empty(N),
        "collected": None,
    } | groups()
    drawn.adam(**fields | changes)


def noise(**changes):
    fields = {name: parameters()[name] for name in ("means", "quats", "log_scales", "logit_opacities")}
    fields |= {"seed": 3, "amount": 0.5, "sharpness": 100.0, "threshold": 0.005}
    _native.noise_f32(**fields | {"threads": 2} | changes)


def loss(**changes):
    fields = {name: torch.zeros(H, W, 3) for name in ("image", "target", "gradient")}
    return _native.loss_f32(**fields | {"ssim_weight": 0.2, "threads": 2} | changes)


def surfel_arrays():
    """Return the arrays of N records without an area, each in all four tiles of an image."""
    plane = {name: torch.zeros(1, H, W) for name in ("transmittance", "distortion", "median")}
    return plane | {
        "records": torch.ones(N, 14),
        "channels": torch.ones(N, 4),
        "tile_begin": torch.arange(5) * N,
        "rows": torch.arange(N).repeat(4),
        "image": torch.zeros(1, H, W, 4),
        "median_places": torch.full((1, H, W), -1),
        "done": torch.full((4,), N),
    }


def surfels(**changes):
    numbers = {"depth": 0, "edge": 4, "tiles_x": 2, "tiles_y": 2, "threads": 2}
    _native.surfels_f32(**surfel_arrays() | numbers | changes)


def surfels_backward(**changes):
    fields = {f"grad_{name}": torch.zeros(1, H, W) for name in ("transmittance", "distortion", "median")}
    fields |= {"grad_image": torch.zeros(1, H, W, 4), "out": torch.empty(N, 18)}
    numbers = {"depth": 0, "edge": 4, "tiles_x": 2, "tiles_y": 2, "threads": 2}
    _native.surfels_backward_f32(**surfel_arrays() | numbers | fields | changes)


def screen_inputs():
    solids = {
        "means": torch.ones(N, 3),
        "covars": None,
        "quats": torch.ones(N, 4),
        "scales": torch.ones(N, 3),
    }
    numbers = {"viewmat": [1.0] * 12, "K": [1.0] * 4, "size": (W, H), "margin": 0.1, "eps2d": 0.3}
    return solids | numbers | {"z_near": 0.1, "z_far": 9.0, "threads": 2}


def screen(**changes):
    fields = {"centres": (N, 2), "depths": (N,), "conics": (N, 3), "compensations": (N,), "spreads": (N, 3)}
    out = {name: torch.empty(shape, dtype=torch.float64) for name, shape in fields.items()}
    out["drawable"] = torch.empty(N, dtype=torch.uint8)
    _native.screen_f32(**screen_inputs() | out | changes)


def screen_backward(**changes):
    names = ("centres", "depths", "conics", "compensations", "spreads")
    fields = {f"grad_{name}": None for name in names}
    fields |= {f"grad_{name}": torch.zeros(N, k) for name, k in (("means", 3), ("quats", 4), ("scales", 3))}
    assert _native.screen_backward_f32(**screen_inputs() | fields | changes) == [0.0] * 16


def radii(**changes):
    fields = {"centres": torch.zeros(N, 2).double(), "spreads": torch.ones(N, 3).double()}
    fields |= {"drawable": torch.ones(N, dtype=torch.uint8), "opacities": None, "compensations": None}
    fields |= {"size": (W, H), "eps2d": 0.3, "extent": 3.0, "radius_clip": 0.0, "threads": 2}
    _native.radii_f32(**fields | {"radii": torch.empty(N, 2, dtype=torch.int32)} | changes)


def harmonics(**changes):
    fields = {"directions": torch.ones(2, 3), "coefficients": torch.ones(N, 4, 3), "degree": 1}
    fields |= {"rows": torch.tensor([3, 1]), "colors": torch.empty(2, 3), "threads": 2}
    _native.harmonics_f32(**fields | changes)


def harmonics_backward(**changes):
    fields = {"directions": torch.ones(2, 3), "coefficients": torch.ones(N, 4, 3), "degree": 1}
    fields |= {"rows": torch.tensor([3, 1]), "grad_colors": torch.ones(2, 3), "overwrites": True}
    fields |= {"grad_directions": torch.empty(2, 3), "grad_coefficients": torch.empty(N, 4, 3), "threads": 2}
    _native.harmonics_backward_f32(**fields | changes)


CALLS = {
    camera: ("R", "eye", "fx", "fy", "cx", "cy", "x_bounds", "y_bounds", "H", "W"),
    settings: ("z_near", "background", "sh_degree", "antialiased", "alpha_max", "pixel_stop"),
    scene: RAW,
    images: ("image", "transmittance", "depth", "features", "median"),
    gradients: (*RAW, "means2d_norm", "background", "camera", "features"),
    statistics: ("values", "errors"),
    frame: ("scene", "camera", "settings", "threads"),
    visible: ("ids", "radii"),
    backward: ("scene", "images", "incoming", "gradients", "features", "collected"),
    adam: (*("parameter", "first", "second", "gradient", "rate", "beta1"), "correction2", "threads"),
    adam_group: (*("parameter", "first", "second", "extra", "rate", "beta1"), "beta2", "eps", "correction2"),
    adam_backward: ("images", "incoming", "means2d_norm", "collected"),
    loss: ("image", "target", "gradient", "ssim_weight", "threads"),
    noise: (
        *("means", "quats", "log_scales", "logit_opacities"),
        *("seed", "amount", "sharpness", "threshold", "threads"),
    ),
    surfels: (*surfel_arrays(), "depth", "edge", "tiles_x", "tiles_y", "threads"),
    surfels_backward: (
        *surfel_arrays(),
        *("grad_image", "grad_transmittance", "grad_distortion", "grad_median", "out", "depth", "threads"),
    ),
    screen: (
        *screen_inputs(),
        *("centres", "depths", "conics", "compensations", "spreads", "drawable"),
    ),
    screen_backward: (
        *("grad_centres", "grad_depths", "grad_conics", "grad_compensations", "grad_spreads"),
        *("grad_means", "grad_quats", "grad_scales"),
    ),
    radii: (
        *("centres", "spreads", "drawable", "opacities", "compensations", "size", "eps2d"),
        *("extent", "radius_clip", "radii", "threads"),
    ),
    harmonics: ("directions", "coefficients", "degree", "rows", "colors", "threads"),
    harmonics_backward: ("grad_colors", "grad_directions", "grad_coefficients", "overwrites", "threads"),
}
EVERY = [(call, name) for call, names in CALLS.items() for name in names]


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.__name__)
def test_the_default_arguments_of_these_tests_are_accepted(call):
    call()
    with pytest.raises(TypeError, match="does not know unknown"):
        call(unknown=1)


@pytest.mark.parametrize(("call", "name"), EVERY, ids=lambda value: getattr(value, "__name__", value))
def test_a_missing_or_invalid_argument_is_named(call, name, monkeypatch):
    with pytest.raises((TypeError, ValueError), match=rf": {name}: "):
        call(**{name: "nonsense"})
    monkeypatch.setitem(call.__globals__, "_native", Dropping(_native, name))
    with pytest.raises(TypeError, match=rf": {name} is missing$"):
        call()


class Dropping:
    """The native module without one argument in every call."""

    def __init__(self, source, name):
        self.source, self.name = source, name

    def __getattr__(self, attribute):
        called = getattr(self.source, attribute)

        def without(*arguments, **fields):
            fields.pop(self.name, None)
            result = called(*arguments, **fields)
            return result if not attribute.startswith("Frame") else Dropping(result, self.name)

        return without if callable(called) else called


ARRAYS = {scene: RAW, gradients: CALLS[gradients], images: CALLS[images], adam: CALLS[adam][:4]}
ARRAYS |= {statistics: CALLS[statistics], adam_group: CALLS[adam_group][:4], adam_backward: ("means2d_norm",)}
ARRAYS |= {loss: CALLS[loss][:3], visible: CALLS[visible], noise: CALLS[noise][:4]}
EACH_ARRAY = [(call, name) for call, names in ARRAYS.items() for name in names]


def valid_array(call, name):
    """Return a valid array for this argument."""
    if call in (scene, gradients, noise) and name in RAW:
        return parameters()[name].clone()
    shapes = {"means2d_norm": (N,), "background": (3,), "ids": (N,), "radii": (N, 2), "depth": (H, W)}
    shapes |= {"transmittance": (H, W), "median": (H, W), "errors": (H, W), "values": (N, 6), "camera": (16,)}
    if call is gradients and name == "features":
        return torch.zeros(N, 2)
    if call in (adam, adam_group):
        return torch.zeros(N, 3)
    dtype = {"ids": torch.int64, "camera": torch.float64}.get(name, torch.float32)
    return torch.zeros(shapes.get(name, (H, W, 3)), dtype=dtype)


def strided(tensor):
    return torch.stack([tensor, tensor], dim=-1)[..., 0]


def unaligned(tensor):
    # NumPy, unlike torch, can make an array at an unaligned address.
    room = np.zeros(tensor.numel() * tensor.element_size() + 1, np.uint8)
    return room[1:].view(tensor.numpy().dtype).reshape(tensor.shape)


WRONG = {
    "half": lambda t: t.to(torch.float16),
    "integers": lambda t: t.to(torch.int32),
    "empty": lambda t: t[:0],
    "one more": lambda t: torch.cat([t, t[:1]]),
    "flat": lambda t: t.reshape(1, -1),
    "strided": strided,
    "unaligned": unaligned,
    "elsewhere": lambda t: t.to("meta"),
    "absent": lambda t: None,
    "nine axes": lambda t: t[(None,) * 9],
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize(("call", "name"), EACH_ARRAY, ids=lambda value: getattr(value, "__name__", value))
def test_an_unsuitable_array_is_refused(call, name, wrong):
    given = valid_array(call, name)
    call(**{name: given})
    optional = wrong == "absent" and (
        name in ("extra", "errors")
        or (call is images and name != "image")
        or (call is gradients and name in ("camera", "features"))
    )
    if call in (images, gradients, statistics) and name in ("features", "errors", "values"):
        # These arrays may have any size, or determine the sizes of others, which a frame checks.
        optional |= wrong in ("empty", "one more", "flat") and (call is not gradients or wrong == "flat")
    if optional or (wrong in ("strided", "unaligned") and not given.numel()):
        return  # these arrays are valid
    # The first array determines the size, so if its size is wrong, the error names the next array.
    leads = name in ("means", "parameter", "image") and wrong in ("empty", "one more", "flat", "nine axes")
    with pytest.raises(ValueError, match=r": \w+: has to be" if leads else rf": {name}: has to be"):
        call(**{name: WRONG[wrong](given)})


LISTS = {
    "tile_begin": (
        [0, 5, 10, 15, 21],
        [0, 5, 4, 15, 20],
        [1, 5, 10, 15, 20],
        [0, 10, 20],
        [-5, 5, 10, 15, 20],
    ),
    "rows": ([N] * 20, [-1] * 20),
    "done": ([0, 0, 0, 6], [-1, 0, 0, 0]),
}


@pytest.mark.parametrize("name", LISTS)
def test_lists_that_lead_outside_the_arrays_are_refused(name):
    for wrong in LISTS[name]:
        with pytest.raises(ValueError, match=f"^surfels_backward: {name}: "):
            surfels_backward(**{name: torch.tensor(wrong)})
        if name != "done":  # it is written by the forward pass
            with pytest.raises(ValueError, match=f"^surfels: {name}: "):
                surfels(**{name: torch.tensor(wrong)})


def test_numpy_arrays_are_accepted_and_read_only_ones_only_as_inputs():
    arrays = {name: np.zeros((N, 3), np.float32) for name in ("parameter", "first", "second", "gradient")}
    for name, array in arrays.items():
        array.flags.writeable = False
        if name == "gradient":
            adam(**arrays | {"gradient": array})
        else:
            with pytest.raises(ValueError, match=f"adam: {name}: has to be .* writable; got no writable"):
                adam(**arrays)
        array.flags.writeable = True


def test_a_leaf_is_updated_in_place():
    leaf = torch.zeros(N, 3, requires_grad=True)
    adam(parameter=leaf, gradient=torch.ones(N, 3))
    assert (leaf.detach() < 0).all()


def test_arguments_that_do_not_fit_the_frame_are_refused():
    cases = (
        ("scene", _native.Scene(**parameters(torch.float64)), "dtype"),
        ("scene", _native.Scene(**{name: tensor[:3] for name, tensor in parameters().items()}), "shape"),
        ("images", images(image=torch.empty(H, W + 1, 3), transmittance=torch.empty(H, W + 1)), "size"),
        ("images", images(transmittance=None), "needs transmittance"),
        ("images", images(depth=torch.empty(H, W)), "depth exactly where"),
        ("incoming", images(depth=torch.empty(H, W)), "not rendered"),
        ("incoming", images(image=torch.empty(H, W, 3).double(), transmittance=None), "dtype"),
        ("incoming", images(median=torch.empty(H, W)), "median depth, which has none"),
        ("features", torch.empty(N, 2), "exactly where the images have"),
        ("incoming", images(features=torch.empty(H, W, 2)), "another number of channels"),
        ("collected", statistics(values=torch.empty(N + 1, 6)), "another number of Gaussians"),
        ("collected", statistics(values=torch.empty(N, 6).double()), "another dtype"),
        ("collected", statistics(errors=torch.empty(H + 1, W)), "errors of another size"),
    )
    for name, value, words in cases:
        with pytest.raises(ValueError, match=f"{name}: .*{words}"):
            backward(**{name: value})
    fields = {"scene": scene(), "images": images(), "incoming": images(), "gradients": gradients()}
    with pytest.raises(ValueError, match="call composite first"):
        frame().backward(**fields, features=None, collected=None)
    with pytest.raises(ValueError, match="sh_degree is above"):
        frame(settings=settings(sh_degree=1))
    with pytest.raises(ValueError, match="H: times W"):
        camera(H=2**31 - 1, W=2**31 - 1)
    for name in ("H", "W"):
        with pytest.raises(ValueError, match=f"Camera: {name}: has to be a whole number"):
            camera(**{name: 0})
    with pytest.raises(ValueError, match="sh_rest: has to hold 0, 3, 8 or 15"):
        scene(sh_rest=torch.zeros(N, 4, 3))
    with pytest.raises(TypeError, match="by name only"):
        _native.Scene(*parameters().values())


@pytest.mark.parametrize("name", RAW)
def test_a_step_in_the_backward_pass_needs_a_fitting_group_for_every_parameter(name):
    drawn, out = frame(), images()
    drawn.composite(images=out, features=None)
    fields = {
        "images": out,
        "incoming": images(),
        "means2d_norm": torch.empty(N),
        "collected": None,
    } | groups()
    drawn.adam(**fields)
    with pytest.raises(TypeError, match=f"Frame.adam: {name} is missing$"):
        drawn.adam(**{key: value for key, value in fields.items() if key != name})
    for wrong in (None, torch.zeros(N, 3), scene()):
        with pytest.raises(ValueError, match=f"Frame.adam: {name}: has to be the structure"):
            drawn.adam(**fields | {name: wrong})
    with pytest.raises(ValueError, match=f"Frame.adam: {name}: is of another dtype"):
        drawn.adam(**fields | {name: groups(torch.float64)[name]})
    for shape in ((N - 1, 3), (N, 5), (N,) if name != "logit_opacities" else (N, 1), (3, N)):
        odd = {part: torch.zeros(shape) for part in ("parameter", "first", "second")}
        with pytest.raises(ValueError, match=f"Frame.adam: {name}: differs in shape"):
            drawn.adam(**fields | {name: adam_group(extra=None, **odd)})


def test_arrays_of_a_step_in_the_backward_pass_must_not_overlap():
    room, means, quats = torch.zeros(4 * N * 3 - 1), parameters()["means"], torch.zeros(N, 4)
    half = room[: N * 3].view(N, 3)
    across = room[N * 3 - 1 : 2 * N * 3 - 1].view(N, 3)
    other = torch.zeros(N, 3)
    norms, shared = torch.zeros(N), torch.zeros(H * W * 3)
    inside = shared[: N * 4].view(N, 4)
    cases = [
        {"means": adam_group(parameter=means, first=half, second=across, extra=None)},
        {"means": adam_group(parameter=means, first=means, second=other, extra=None)},
        {"means": adam_group(parameter=means, first=other, second=half, extra=other)},
        {"means": adam_group(parameter=means, first=half, second=other, extra=None)}
        | {"log_scales": adam_group(parameter=means.clone(), first=half, second=other.clone(), extra=None)},
        {"means2d_norm": norms}
        | {"logit_opacities": adam_group(parameter=norms, first=norms + 1, second=norms + 2, extra=None)},
        {"means2d_norm": norms, "collected": statistics(errors=None, values=torch.zeros(N, 6))}
        | {"logit_opacities": adam_group(parameter=norms + 3, first=norms, second=norms + 2, extra=None)},
        {"collected": statistics(values=room[: N * 6].view(N, 6))}
        | {"means": adam_group(parameter=means, first=half, second=other, extra=None)},
        {"incoming": images(image=shared.view(H, W, 3))}
        | {"quats": adam_group(parameter=quats, first=inside, second=quats + 1, extra=None)},
    ]
    for case in cases:
        with pytest.raises(ValueError, match=r"Frame.adam: \w+: has an array that overlaps another one"):
            adam_backward(**case)
    touching = room[N * 3 : 2 * N * 3].view(N, 3)
    adam_backward(means=adam_group(parameter=means, first=half, second=touching, extra=other))


def test_features_have_the_frame_s_rows_and_at_most_32_channels():
    given = torch.ones(N, 2)
    drawn, out = frame(), images(features=torch.empty(H, W, 2))
    drawn.composite(images=out, features=given)
    fields = {"scene": scene(), "images": out, "incoming": images(features=torch.ones(H, W, 2))}
    fields |= {"features": given, "collected": None}
    drawn.backward(**fields, gradients=gradients(features=torch.empty(N, 2)))
    for wrong in (None, torch.empty(N, 3)):
        with pytest.raises(ValueError, match="gradients: needs features"):
            drawn.backward(**fields, gradients=gradients(features=wrong))
    for wrong in (torch.ones(N + 1, 2), torch.ones(N, 3), None):
        with pytest.raises(ValueError, match="features: has to be"):
            drawn.composite(images=out, features=wrong)
    for channels in (0, 33):
        with pytest.raises(ValueError, match="features: has to have 1 to 32 channels"):
            images(features=torch.empty(H, W, channels))
    with pytest.raises(ValueError, match="images: have features, which Adam does not move"):
        drawn.adam(images=out, incoming=images(), means2d_norm=torch.empty(N), collected=None, **groups())


@pytest.mark.parametrize("clamp", [0.003, 1.0, float("nan")])
def test_the_clamp_of_alpha_is_below_one_and_above_the_cut(clamp):
    with pytest.raises(ValueError, match="Settings: alpha_max: has to be"):
        settings(alpha_max=clamp)


def test_a_step_in_the_backward_pass_needs_a_composited_frame_of_raw_parameters():
    fields = {
        "images": images(),
        "incoming": images(),
        "means2d_norm": torch.empty(N),
        "collected": None,
    } | groups()
    with pytest.raises(ValueError, match="call composite first"):
        frame().adam(**fields)
    arrays = {"means": (N, 3), "cov3ds": (N, 3, 3), "colors": (N, 3), "opacities": (N,)}
    tensors = {name: torch.zeros(shape) for name, shape in arrays.items()}
    tensors["cov3ds"] = tensors["cov3ds"].double()
    direct = frame(scene=_native.Scene(**tensors))
    direct.composite(images=fields["images"], features=None)
    with pytest.raises(ValueError, match="Adam moves raw parameters"):
        direct.adam(**fields)
    with pytest.raises(ValueError, match="incoming: has another size"):
        adam_backward(incoming=images(image=torch.empty(H, W + 1, 3), transmittance=None))


@pytest.mark.parametrize("degree", [0, 1])
def test_capsules_of_older_torch_give_the_same_bits(monkeypatch, degree):
    """Versions of torch without DLPack's C interface pass capsules, also for leaves that require a gradient."""
    cam = orbit_camera(0.3, 0.2, 24, 30.0)
    target = torch.randint(0, 256, (24, 24, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    found = []
    for describes in (True, False):
        monkeypatch.setattr(kernels, "DESCRIBE_THEMSELVES", describes)
        raw = parameters() | {"sh_rest": torch.zeros(N, (degree + 1) ** 2 - 1, 3)}
        gaussians = Gaussians(**raw).trainable()
        optimizer = Adam(gaussians.tensors(), dict.fromkeys(raw, 0.01))
        for _ in range(2):
            photo_loss(render(gaussians, cam, backend="cpu").image, target).backward()
            optimizer.step(gaussians.tensors())
        found.append(gaussians.tensors())
    for name, tensor in found[0].items():
        assert torch.equal(tensor, found[1][name]), name
    assert not torch.equal(found[0]["means"], parameters()["means"])
