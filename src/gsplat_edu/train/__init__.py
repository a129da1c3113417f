"""Learning Gaussians from views: initialise, render, compare, step, densify.

The trainer takes views and a renderer and reports to callbacks. It knows neither datasets nor backends.
"""
