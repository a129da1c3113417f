"""What a training can have besides Gaussians, photos and a strategy: one room for each part.

`gsplat_edu.train.part` registers them; what composes a training loops over the registered parts.
"""
