"""Write a procedural city as a COLMAP capture: a test of captures with thousands of photos.

python tools/make_city.py FOLDER [--photos 1500] [--width 192] [--street 0.1] [--seed 0] [--workers 2]
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

from lab.captures.city import City, write_city


def main() -> None:
    """Parse the options and write the capture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="the capture to write")
    parser.add_argument("--photos", type=int, default=City.photos, metavar="N")
    parser.add_argument("--width", type=int, default=City.width, metavar="PX")
    parser.add_argument(
        "--street", type=float, default=City.street, metavar="SHARE", help="photos from the streets"
    )
    parser.add_argument("--points", type=int, default=City.points, metavar="N", help="points for each photo")
    parser.add_argument("--seed", type=int, default=City.seed, metavar="N")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="processes")
    given = parser.parse_args()
    city = City(given.photos, given.width, given.street, given.points, given.seed)
    began = time.perf_counter()

    def progress(done: int) -> None:
        if done % 100 == 0:
            print(f"{done} of {city.photos} photos after {time.perf_counter() - began:.0f} s", flush=True)

    write_city(given.folder, city, given.workers, progress)
    print(
        f"wrote {given.folder}: {city.photos} photos of {city.width}x{city.height} px, {city.side:g} units wide"
    )


if __name__ == "__main__":
    main()
