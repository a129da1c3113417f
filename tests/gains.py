"""A view model for tests of the trainer."""

import torch

from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.view_model import Identity


class Gains(Identity):
    """A small view model: a brightness per view."""

    def __init__(self, count):
        self.gains = torch.ones(count).requires_grad_()

    def parameters(self):
        return {"gains": self.gains}

    def groups(self):
        return {"gains": ParameterGroup(0.02, eps=1e-8, per_gaussian=False)}

    def correct(self, index, render, target, rows):
        return render.image * self.gains[index]
