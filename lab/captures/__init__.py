"""Captures and faults of known truth, for tests, benchmarks, chapters and tools.

Photos are ray traced or drawn from surfaces, not from splats, so training on them is an independent test.
"""
