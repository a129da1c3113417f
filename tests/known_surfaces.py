"""Solids whose depth is known exactly, and properties of meshes."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gsplat_edu import Camera
from gsplat_edu.scene.mesh import Mesh

BOX_NORMALS = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0.634, 0.634, 0.4428]]
)
BOX_NORMALS /= np.linalg.norm(BOX_NORMALS, axis=1, keepdims=True)
BOX_OFFSETS = np.array([0.8, 0.8, 0.7, 0.7, 0.9, 0.9, 0.85])
"""A box from which the last plane cuts a corner: n · x <= offset."""


def orbit(count=32, H=240, W=320, focal=300.0):
    """Cameras 3 world units from the middle, spread over the sphere by the golden angle."""
    k = np.arange(count) + 0.5
    y, angle = 1 - 2 * k / count, np.pi * (3 - 5**0.5) * k
    across = np.sqrt(1 - y * y)
    eyes = 3 * np.stack([across * np.cos(angle), y, across * np.sin(angle)], axis=-1)
    return [
        Camera.looking_at(eye, (0.013, 0.02, -0.01), focal, focal, H, W, up=(0.1, -1, 0.05)) for eye in eyes
    ]


def rays(camera):
    """(H, W, 3) directions in the world, of depth 1."""
    u, v = np.meshgrid(np.arange(camera.W), np.arange(camera.H))
    inside = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)]
    return np.stack(inside, axis=-1) @ camera.R


def sphere_depth(camera):
    """(H, W) depth of the unit sphere; 0 beside it."""
    d = rays(camera)
    a, b = (d * d).sum(-1), d @ camera.eye
    root = b * b - a * (camera.eye @ camera.eye - 1)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)


def box_depth(camera):
    """(H, W) depth of the cut box; 0 beside it."""
    toward = rays(camera) @ BOX_NORMALS.T
    t = (BOX_OFFSETS - BOX_NORMALS @ camera.eye) / toward
    near = np.where(toward < 0, t, -np.inf).max(-1)
    far = np.where(toward > 0, t, np.inf).min(-1)
    return np.where(near < far, near, 0)


def directed_edges(mesh):
    """(3 F, 2) edges of all faces, in the faces' direction."""
    return np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])


def open_edges(mesh):
    """Edges of one face only. Fails if two faces run along an edge in the same direction: then it is no manifold."""
    edges = directed_edges(mesh)
    there, back = (edges @ [len(mesh.vertices), 1], edges @ [1, len(mesh.vertices)])
    assert len(np.unique(there)) == len(there)
    return edges[~np.isin(there, back)]


def assert_closed_manifold(mesh):
    """Each edge twice, in opposite directions; around each vertex, the faces form one ring; no vertex is left over."""
    assert len(mesh.faces) and len(open_edges(mesh)) == 0
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    a, b, c = np.concatenate([np.roll(mesh.faces, k, axis=1) for k in range(3)]).T
    spokes = np.unique(a * len(mesh.vertices) + b)
    first, second = (np.searchsorted(spokes, a * len(mesh.vertices) + end) for end in (b, c))
    ring = coo_matrix((np.ones(len(a)), (first, second)), shape=(len(spokes), len(spokes)))
    assert connected_components(ring, directed=False, return_labels=False) == len(mesh.vertices)


def euler(mesh):
    """Vertices - edges + faces of a closed mesh."""
    return len(mesh.vertices) - 3 * len(mesh.faces) // 2 + len(mesh.faces)


def enclosed(mesh):
    """Volume inside; positive if the faces look outward."""
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return (np.cross(a, b) * c).sum() / 6


def joined(*meshes):
    """Return several meshes as one."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + at for mesh, at in zip(meshes, offsets, strict=False)]),
    )


def torus(around=24, tube=12, R=1.0, r=0.4):
    """Return a closed torus, faces outward."""
    i, j = np.meshgrid(np.arange(around), np.arange(tube), indexing="ij")
    a, b = 2 * np.pi * i / around, 2 * np.pi * j / tube
    out = R + r * np.cos(b)
    vertices = np.stack([out * np.cos(a), out * np.sin(a), r * np.sin(b)], -1).reshape(-1, 3)

    def at(k, m):
        return ((k % around) * tube + m % tube).ravel()

    one, two, three, four = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    return Mesh(vertices, np.concatenate([np.stack([one, two, three], 1), np.stack([one, three, four], 1)]))
