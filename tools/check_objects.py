"""Check that the kernels of different instruction sets share no code.

    python tools/check_objects.py BUILD_FOLDER

If the compiler emits a function as a weak symbol in several object files, the linker keeps only one copy, perhaps the
one for a newer machine than the current one. So every weak symbol of a kernel's object file must be in that instruction
set's own namespace. Prints one line for each that is not, and exits with 1.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

OWN = re.compile(r"gsplat::(v[234]|baseline)::")


def shared(build: Path) -> list[str]:
    """List the weak symbols of kernel object files that are outside their own namespace."""
    objects = sorted(build.glob("**/kernels_*.dir/**/*.o"))
    if not objects:
        return [f"{build}: contains no kernel object files; give the cmake build folder"]
    found = []
    for path in objects:
        listing = subprocess.run(["nm", "-C", str(path)], capture_output=True, text=True, check=True).stdout
        for line in listing.splitlines():
            parts = line.split(maxsplit=2)
            if len(parts) == 3 and parts[1] in "VWu" and not OWN.search(parts[2]):
                found.append(f"{path.name}: {parts[2]}")
    return found


if __name__ == "__main__":
    lines = shared(Path(sys.argv[1]))
    print("\n".join(lines) if lines else "no code is shared between instruction sets")
    sys.exit(bool(lines))
