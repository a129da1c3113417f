"""Small databases as COLMAP writes them, with the tables that a diagnosis reads, and blank photos."""

import sqlite3
from contextlib import closing

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


def write_photos(folder, count):
    """Write blank photos."""
    folder.mkdir()
    for number in range(count):
        Image.new("RGB", (64, 48), (200, 200, 200)).save(folder / f"{number}.png")
