"""The program that calls COLMAP: one job of structure from motion, in its own process.

    python engine/__main__.py < job.json

It imports nothing else from this package. It is a separate process for three reasons: COLMAP's code cannot be
interrupted, but a process can be ended; a crash does not affect the caller; and its libraries crash those of Pillow if
both are loaded into one process, pycolmap first. `gsplat_edu.sfm.colmap` starts it and reads the JSON lines that the
job prints on stdout; COLMAP's own output goes to stderr.
"""
