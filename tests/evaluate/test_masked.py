"""Pictures of masked things."""

import numpy as np

from gsplat_edu.evaluate.masked import OUTLINE, MaskedPicture, masked_figures, outlined


def test_the_mask_is_tinted_and_outlined_and_the_rest_stays():
    photo = np.full((40, 60, 3), 100, np.uint8)
    masked = np.zeros((40, 60), bool)
    masked[10:20, 10:30] = True
    image = outlined(photo, masked)
    assert (image[~masked] == 100).all()
    assert (image[10, 10:30] == OUTLINE).all() and (image[10:20, 29] == OUTLINE).all()
    assert (image[12:18, 12:28] == image[15, 15]).all() and image[15, 15, 0] > 100 > image[15, 15, 1]


def test_figures_name_photo_and_share_and_escape_names():
    photo = np.zeros((40, 60, 3), np.uint8)
    masked = np.zeros((40, 60), bool)
    masked[:4] = True
    page = masked_figures([MaskedPicture.of("<a>.jpg", photo, masked, photo)])
    assert "&lt;a&gt;.jpg: 10.0 % masked" in page and "<a>" not in page
    assert page.count("data:image/jpeg;base64,") == 2
    assert masked_figures([]) == ""
