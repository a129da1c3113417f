"""Remove floaters and invisible splats from a trained scene, judged by the capture's photos."""
