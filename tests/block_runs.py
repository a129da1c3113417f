"""The recipe of the runs in blocks that the tests train."""

RECIPE = [
    *("--min-views", "8", "--iterations", "40", "--coarse-iterations", "30"),
    *("--strategy", "fast", "--max-gaussians", "3000", "--set", "min_opacity=0.005"),
    *("--appearance", "none", "--sky", "none", "--eval-every", "0", "--save-every", "10"),
]
"""Options of every run here. The blocks grow, so that density control is part of what has to be repeated."""
