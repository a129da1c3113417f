"""View models, which stand between the Gaussians and the photo of one view.

A view model may correct the camera a view is rendered from, and the colours of the render before they are compared with
the photo. It learns these corrections for each view, so that the Gaussians need not explain them. Measuring a view and
correcting it are two methods, and neither changes the model: the trainer stores what was measured.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.camera import Camera
from gsplat_edu.train.feed import Color, Target
from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.rendered import NOTHING, Needs


class ViewRender(NamedTuple):
    """The render of a view, as a view model gets it.

    Args:
        image: (H, W, 3) the render, as corrected by earlier models of a chain.
        transmittance: (H, W) fraction of light that passes all Gaussians.
        background: Colour behind the Gaussians.
        camera: The camera that the render shows; None if no model asks for it.
        depth: (H, W) its median depth, 0 where nothing solid is shown; None unless a model needs it.
    """

    image: Float[Tensor, "H W 3"]
    transmittance: Float[Tensor, "H W"]
    background: Color
    camera: Camera | CameraTensors | None = None
    depth: Float[Tensor, "H W"] | None = None


Rows = Mapping[str, Tensor]
"""A view's row of each measured tensor, by name."""


@runtime_checkable
class ViewModel(Protocol):
    """Corrects the camera and the image of a view.

    Its state consists of its parameters, which checkpoints store by name. Those with a group are leaves that collect
    gradients, and the trainer's optimiser updates them in place. The others are measured: they have a row for each
    view, which the trainer replaces by what `measure` returns, once all views of a step are rendered. Names must differ
    from those of the Gaussians' parameters.

    """

    @property
    def needs(self) -> Needs:
        """What it reads of a render besides image and transmittance."""
        ...

    def parameters(self) -> Mapping[str, Tensor]:
        """Return the learned tensors by name; always the same objects."""
        ...

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return the optimiser settings of the parameters that gradients move, by name; none is per Gaussian."""
        ...

    def camera(self, index: int, camera: Camera | CameraTensors) -> Camera | CameraTensors:
        """Return the camera to render the view from, differentiable in the parameters.

        Args:
            index: Index into the trainer's views.
            camera: The view's camera, at the size of this step's photo.
        """
        ...

    def measure(self, index: int, render: ViewRender, target: Target, iteration: int) -> Rows:
        """Return the view's rows of the measured tensors after this render; the model itself stays unchanged.

        Args:
            index: Index into the trainer's views.
            render: The render.
            target: The photo that it is compared with, and its mask.
            iteration: Counted from 0.
        """
        ...

    def correct(self, index: int, render: ViewRender, target: Target, rows: Rows) -> Float[Tensor, "H W 3"]:
        """Return the image that is compared, differentiable in the render and in the parameters with a group.

        Args:
            index: Index into the trainer's views.
            render: The render.
            target: The photo that it is compared with.
            rows: What `measure` returned for this render, to use instead of the view's stored rows.
        """
        ...


class Identity:
    """Corrects nothing and learns nothing; a base class for models that correct only one of camera and image."""

    @property
    def needs(self) -> Needs:
        """Nothing; image and transmittance of every pixel for a subclass that does not say so itself."""
        return NOTHING if type(self) is Identity else Needs()

    def parameters(self) -> Mapping[str, Tensor]:
        """Return none."""
        return {}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return none."""
        return {}

    def camera(self, index: int, camera: Camera | CameraTensors) -> Camera | CameraTensors:
        """Return the camera unchanged."""
        return camera

    def measure(self, index: int, render: ViewRender, target: Target, iteration: int) -> Rows:
        """Return none."""
        return {}

    def correct(self, index: int, render: ViewRender, target: Target, rows: Rows) -> Float[Tensor, "H W 3"]:
        """Return the image unchanged."""
        return render.image


class Chain:
    """A chain of view models; each corrects the output of the one before it.

    Args:
        models: The models; the names of their parameters differ.
    """

    def __init__(self, models: Sequence[ViewModel]) -> None:
        self.models = tuple(models)

    @property
    def needs(self) -> Needs:
        """What any of them reads."""
        return functools.reduce(operator.or_, (model.needs for model in self.models), NOTHING)

    def parameters(self) -> Mapping[str, Tensor]:
        """Return the parameters of all models."""
        return {name: tensor for model in self.models for name, tensor in model.parameters().items()}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return the groups of all models."""
        return {name: group for model in self.models for name, group in model.groups().items()}

    def camera(self, index: int, camera: Camera | CameraTensors) -> Camera | CameraTensors:
        """Return the camera after all models."""
        for model in self.models:
            camera = model.camera(index, camera)
        return camera

    def measure(self, index: int, render: ViewRender, target: Target, iteration: int) -> Rows:
        """Return the rows of all models, each measured on the image that the models before it corrected."""
        rows: dict[str, Tensor] = {}
        for model in self.models:
            rows |= model.measure(index, render, target, iteration)
            if model is not self.models[-1]:
                render = render._replace(image=model.correct(index, render, target, rows))
        return rows

    def correct(self, index: int, render: ViewRender, target: Target, rows: Rows) -> Float[Tensor, "H W 3"]:
        """Return the image after all models."""
        for model in self.models:
            render = render._replace(image=model.correct(index, render, target, rows))
        return render.image


def chained(models: Sequence[ViewModel]) -> ViewModel:
    """Return one view model that applies some in turn."""
    return models[0] if len(models) == 1 else Chain(models) if models else Identity()
