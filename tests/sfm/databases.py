"""Small databases as COLMAP writes them, with the tables that a diagnosis or a choice of pairs reads; blank photos."""

import sqlite3
from contextlib import closing

import numpy as np
from PIL import Image


def write_database(path, features, pairs):
    """Write the numbers of features by photo, and for each matched pair its inliers and kind of geometry."""
    with closing(sqlite3.connect(path)) as writer, writer:
        writer.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        writer.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER)")
        writer.execute("CREATE TABLE matches (pair_id INTEGER, rows INTEGER)")
        writer.execute("CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER, config INTEGER)")
        for number, count in enumerate(features):
            writer.execute("INSERT INTO images VALUES (?, ?)", (number, f"{number}.png"))
            writer.execute("INSERT INTO keypoints VALUES (?, ?)", (number, count))
        for number, (inliers, kind) in enumerate(pairs):
            writer.execute("INSERT INTO matches VALUES (?, ?)", (number, 2 * inliers))
            writer.execute("INSERT INTO two_view_geometries VALUES (?, ?, ?)", (number, inliers, kind))


def random_descriptors(rng, count):
    """Return descriptors of COLMAP's length in bytes, (count, 128)."""
    positive = rng.exponential(size=(count, 128))
    return np.round(512.0 * positive / np.linalg.norm(positive, axis=1, keepdims=True)).astype(np.uint8)


def write_features(path, photos):
    """Write the features of photos: by name, their descriptors (n, 128) and scales (n,)."""
    rng = np.random.default_rng(0)
    with closing(sqlite3.connect(path)) as writer, writer:
        writer.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        writer.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        writer.execute("CREATE TABLE descriptors (image_id INTEGER, data BLOB)")
        for i, (name, (descriptors, scales)) in enumerate(photos.items()):
            keypoints, turns = np.zeros((len(scales), 6), np.float32), rng.uniform(0.0, 6.3, len(scales))
            cosines, sines = scales * np.cos(turns), scales * np.sin(turns)
            keypoints[:, 2:] = np.stack([cosines, -sines, sines, cosines], axis=1)
            writer.execute("INSERT INTO images VALUES (?, ?)", (i, name))
            writer.execute("INSERT INTO keypoints VALUES (?, ?, 6, ?)", (i, len(scales), keypoints.tobytes()))
            writer.execute("INSERT INTO descriptors VALUES (?, ?)", (i, descriptors.tobytes()))


def write_photos(folder, count):
    """Write blank photos."""
    folder.mkdir()
    for number in range(count):
        Image.new("RGB", (64, 48), (200, 200, 200)).save(folder / f"{number}.png")
