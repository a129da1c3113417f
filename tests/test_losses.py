import torch

from gsplat_edu.losses import l1


def test_l1_is_the_mean_over_pixels_and_channels():
    image = torch.zeros(2, 3, 3, dtype=torch.float64, requires_grad=True)
    target = torch.full((2, 3, 3), 0.5, dtype=torch.float64)
    target[0, 0, 0] = -1.0
    loss = l1(image, target)
    assert abs(loss.item() - (17 * 0.5 + 1.0) / 18) < 1e-15
    loss.backward()
    torch.testing.assert_close(image.grad, torch.sign(-target) / 18)
