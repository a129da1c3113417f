"""Decoders' warnings are ignored without those of this package, whatever the threads that decode do."""

import warnings

import pytest

from gsplat_edu.base.errors import BackendWarning
from gsplat_edu.photos.image_files import quiet_decoders


def test_threads_that_end_in_another_order_than_they_began_leave_our_warnings_on():
    """Each thread restores the filters that it found, so the last one to end leaves the filters of the first."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first, second = quiet_decoders(), quiet_decoders()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        second.__exit__(None, None, None)
        warnings.warn("left behind", UserWarning, stacklevel=1)
        with warnings.catch_warnings(record=True) as heard:
            warnings.warn("the device was lost", BackendWarning, stacklevel=1)
        assert [str(one.message) for one in heard] == ["the device was lost"]


def test_warnings_of_a_decoder_are_ignored():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with quiet_decoders():
            warnings.warn("Corrupt EXIF data", UserWarning, stacklevel=1)
        with pytest.raises(UserWarning):
            warnings.warn("after it", UserWarning, stacklevel=1)
