"""How a notebook shows a scene: a small picture with its facts, or the viewer's page in a frame."""

from __future__ import annotations

import html
from dataclasses import dataclass
from pathlib import Path

import torch

from gsplat_edu.base.files import written_aside
from gsplat_edu.base.pictures import picture_html, png
from gsplat_edu.base.validation import whole_number
from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.orbits import orbit_of_scene
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import WORLD_UP
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer.page import html as page_html

SIDE = 256
"""Width and height of a scene's picture, px."""

MOST_DRAWN = 200_000
"""Most Gaussians of a picture; of a larger scene, the most opaque ones are drawn."""


def scene_html(shown: Scene | Gaussians) -> str:
    """Return a small picture of a scene and its facts as HTML.

    Args:
        shown: The scene, or its Gaussians.
    """
    scene = _scene(shown)
    usable = scene.gaussians[scene.gaussians.finite_rows()]
    facts = repr(shown)
    if not len(usable):
        return f"<div><code>{html.escape(facts)}</code></div>"
    size = (usable.means.amax(dim=0) - usable.means.amin(dim=0)).tolist()
    unit = scene.unit or "world units"
    facts += f", {' x '.join(f'{side:.3g}' for side in size)} {unit}"
    if len(usable) > MOST_DRAWN:
        usable = usable[usable.logit_opacities.topk(MOST_DRAWN).indices]
    with torch.no_grad():
        camera = orbit_of_scene(usable, 1, SIDE, WORLD_UP if scene.up is None else scene.up)[0]
        settings = RenderSettings(antialiased=bool(scene.antialiased), depth=False)
        image = render(usable.map(torch.Tensor.detach), camera, settings=settings).image
    return picture_html(png(image), facts)


@dataclass(frozen=True, eq=False, repr=False)
class ScenePage:
    """The viewer's page of a scene, which a notebook shows in a frame.

    Args:
        content: The page: one HTML document that needs no server.
        height: Height of the frame, px.
    """

    content: bytes
    height: int

    def __repr__(self) -> str:
        """Return one line, with what to do outside of a notebook."""
        return f"ScenePage({len(self.content):,} bytes; a notebook shows it; page.save(path) writes it)"

    def save(self, path: str | Path) -> None:
        """Write the page to a file, which any browser with WebGL2 shows.

        Args:
            path: Output file; parent folders are created.

        Raises:
            OSError: the file cannot be written. An existing file stays unchanged.
        """
        with written_aside(Path(path)) as aside:
            aside.write_bytes(self.content)

    def _repr_html_(self) -> str:
        document = html.escape(self.content.decode("utf-8"), quote=True)
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe sandbox="allow-scripts" srcdoc="{document}" style="{style}"></iframe>'


def scene_page(shown: Scene | Gaussians, height: int) -> ScenePage:
    """Return the viewer's page of a scene.

    Args:
        shown: The scene, or its Gaussians.
        height: Height of the frame, px.

    Raises:
        ArgumentError: the height is not a whole number of at least 100, or a parameter is NaN or infinite.
    """
    return ScenePage(page_html(_scene(shown)), whole_number("height", height, 100))


def _scene(shown: Scene | Gaussians) -> Scene:
    return shown if isinstance(shown, Scene) else Scene(shown)
