"""A scene with its edits applied, and the tour of its page: for converted files and for the studio's pages."""

from __future__ import annotations

from dataclasses import replace

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.edits.apply import Views, edited, moved_together, placed, views_after
from gsplat_edu.edits.document import Edits
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.edit import IDENTITY, Similarity
from gsplat_edu.paths.keyframes import KeyframePath
from gsplat_edu.runs.source import Source
from gsplat_edu.viewer.edit_page import tour_of
from gsplat_edu.viewer.page import Tour
from gsplat_edu.viewer.page_mesh import Meshes


def edited_source(source: Source, edits: Edits, name: str, anyway: bool = False) -> Source:
    """Apply the operations of an edits file: the splats that are left, moved like the cameras.

    Args:
        source: The scene.
        edits: The edits.
        name: Their file, for messages.
        anyway: Whether to apply edits of another scene.

    Raises:
        ArgumentError: the edits belong to another scene, or leave no splat.
    """
    scene, views = source.scene, views_after(edits.operations)
    edits.check_scene(identity_of(scene), name, anyway)
    left = edited(scene, edits.operations)
    if not len(left.gaussians):
        raise ArgumentError(
            f"{name}: leaves none of {len(scene.gaussians):,} splats; remove a deletion from it"
        )
    cameras = source.cameras
    if views.move is not IDENTITY:
        cameras = tuple((name, views.move.camera(camera)) for name, camera in cameras)
    return replace(source, scene=placed(left, views), cameras=cameras)


def edited_meshes(meshes: Meshes | None, source: Source, edits: Edits) -> Meshes | None:
    """Move meshes beside a scene as its edits move all splats that are left; a move of some of them leaves the meshes.

    Args:
        meshes: In the coordinates of the scene; None for none.
        source: The scene before the edits.
        edits: The edits. Their level floor and scale are left to `Meshes.moved`.
    """
    if meshes is None:
        return None
    move, some = moved_together(edits.operations, source.scene.gaussians)
    return replace(meshes if move is IDENTITY else meshes.moved(move), stays=some)


def toured(source: Source, views: Views, move: Similarity, along: KeyframePath | None = None) -> Tour:
    """Return the tour of an edited scene's page.

    Args:
        source: The edited scene, after all moves.
        views: The views of its edits.
        move: All moves, that of the edits included, from the coordinates of the opened scene to those of `source`.
        along: A camera path instead of that of the edits, in the coordinates of the opened scene.
    """
    path = views.path if along is None else along
    if path is not None:
        path = path.placed(move.R, move.s, move.t)
    return tour_of(source, views, move, path)
