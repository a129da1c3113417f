"""The recipe of the tests' runs in blocks."""

RECIPE = [
    *("--min-views", "8", "--iterations", "40", "--coarse-iterations", "30"),
    *("--strategy", "fast", "--max-gaussians", "3000", "--set", "min_opacity=0.005"),
    *("--appearance", "none", "--sky", "none", "--eval-every", "1000", "--save-every", "10"),
]
"""Options of each run. The blocks grow, so that repeating a run repeats density control, too."""
