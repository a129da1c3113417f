"""The mesh of a scene checks what it is made of."""

import numpy as np
import pytest

from gsplat_edu import ArgumentError
from gsplat_edu.scene.mesh import Mesh, Texture

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]])
TWO = np.array([[0, 2, 1], [0, 3, 2]])
SHADES = np.linspace(0, 1, 15, dtype=np.float32).reshape(5, 3)


def test_normals_and_unused_vertices():
    mesh = Mesh(SQUARE, TWO, SHADES)
    assert np.array_equal(mesh.face_normals(), [[0, 0, -1], [0, 0, -1]])
    used = mesh.used()
    assert len(used.vertices) == 4 and np.array_equal(used.corners, mesh.corners)
    assert np.array_equal(used.colors, SHADES[:4])
    assert repr(mesh) == "Mesh(5 vertices, 2 faces, colors)"


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("name vertices 3 to 6", {"faces": TWO + 3}),
        ("name vertices -1", {"faces": TWO - 1}),
        ("NaN", {"vertices": np.where(SQUARE == 9, np.nan, SQUARE)}),
        ("are 4, but there are 5 vertices", {"colors": SHADES[:4]}),
        (
            "1 uvs for 2 faces",
            {"texture": Texture(np.zeros((2, 2, 3), np.uint8), np.zeros((1, 3, 2), np.float32))},
        ),
    ],
)
def test_what_does_not_fit_is_named(words, parts):
    with pytest.raises(ArgumentError, match=words):
        Mesh(**({"vertices": SQUARE, "faces": TWO} | parts))
