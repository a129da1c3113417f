"""Learning Gaussians from views: initialise, render, compare, step, densify.

The trainer is fed views and a renderer and reports to callbacks. It knows no dataset and no backend.
"""
