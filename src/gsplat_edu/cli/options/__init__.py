"""The options of every command, a module each: EXAMPLE and `add_arguments`, and `check` where there is one.

Nothing here imports torch, OpenCV, SciPy or matplotlib, which take seconds: usage errors, `--help` and values that are
out of range are answered before a command's own module, `gsplat_edu.cli.NAME` with its `run`, is imported.
"""
