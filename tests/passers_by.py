"""Photos with pasted objects, and the pixels that the objects cover."""

import numpy as np

from gsplat_edu.scene.views import View


def pasted(views, share=0.3, seed=3, area=0.05):
    """Paste a textured rectangle near the middle of some views; return all views and their covered pixels."""
    rng = np.random.default_rng(seed)
    struck = rng.permutation(len(views))[: round(share * len(views))]
    changed, truth = list(views), [np.zeros(view.image.shape[:2], bool) for view in views]
    for i in struck:
        H, W = truth[i].shape
        h, w = round(np.sqrt(2 * area) * H), round(np.sqrt(area / 2) * W)
        top, left = rng.integers(H // 4, 3 * H // 4 - h), rng.integers(W // 4, 3 * W // 4 - w)
        image, block = views[i].image.copy(), (slice(top, top + h), slice(left, left + w))
        here = image[block].mean(axis=(0, 1))
        image[block] = np.clip(np.where(here > 128, 30, 220) + rng.integers(-20, 21, (h, w, 3)), 0, 255)
        truth[i][block] = True
        changed[i] = View(views[i].camera, image, mask=views[i].read().mask, name=views[i].name)
    return changed, truth
