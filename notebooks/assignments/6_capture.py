"""Assignment 6, your own capture: photos, a scene, and an honest score. For chapter 14; 10 points.

Take at least 30 photos of a thing that does not move, find their poses with gsplat-edu sfm, and train with gsplat-edu
train. RUN names the folder that train wrote. Held-out photos are scored anew.

Run: gsplat-edu grade notebooks/assignments/6_capture.py
"""

ASSIGNMENT = "capture"
RUN = "../../runs/plush"
