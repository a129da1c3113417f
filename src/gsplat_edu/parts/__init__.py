"""What a training can have besides Gaussians, photos and a strategy: one room for each part.

`gsplat_edu.train.part` registers them. Whoever composes a training or a run loops over the registered parts.
"""
