"""The options of every command, one module each: EXAMPLE, `add_arguments`, and optionally `check` and COMMON.

COMMON names the options that `--help` shows where a command has many; `--help-all` shows the others too, and what
`appendix` returns. `explain_unknown` says what to write instead of an unknown option.

Nothing here imports torch, OpenCV, SciPy or matplotlib, which take seconds: usage errors, `--help` and values out of
range are answered before the command's own module, `gsplat_edu.cli.NAME` with its `run`, is imported.
"""
