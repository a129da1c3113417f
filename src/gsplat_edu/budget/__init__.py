"""Forecast the cost of a training on this machine, and keep limits of time and memory."""
