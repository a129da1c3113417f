"""The ladder: the same image from kernels that each do one thing more cleverly than the one below.

    naive -> tiled -> tight -> simd -> the package's own kernels

Chapters 10 and 11 climb it forward, chapter 12 backward. Every rung is a few dozen lines of C++ beside its reference
and its timing; `python benchmarks/ladder` prints the table.
"""
