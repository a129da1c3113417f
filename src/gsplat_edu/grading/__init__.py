"""The course's assignments, and what grades them.

assignment    what an assignment is made of, and how an answer is judged
submission    a file with answers
geometry      1, projection
layers        2, compositing
derivatives   3, the chain of gradients
tiles         4, tiles
density       5, density control
capture       6, one's own capture
"""

from __future__ import annotations
