"""The ladder: kernels that draw the same image, each with one improvement over the one below.

    naive -> tiled -> tight -> simd -> the package's own kernels

Chapters 10 and 11 climb the forward rungs, chapter 12 the backward ones. Every rung is a few dozen lines of C++, with
a reference and a timing; `python benchmarks/ladder` prints the table. `gpu.py` runs the same steps as WGSL kernels.
"""
