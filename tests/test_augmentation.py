"""Crops and shifts against pictures whose pixels say where they come from."""

import itertools

import numpy as np
import pytest
import torch as th

from sb3_aarl.augmentation import center_crop, random_crop, random_shift

DTYPES = [th.uint8, th.float32]


def pictures(batch: int, channels: int, height: int, width: int, dtype: th.dtype = th.float32) -> th.Tensor:
    """Pictures without two equal pixels (as far as the dtype goes)."""
    values = th.arange(batch * channels * height * width).reshape(batch, channels, height, width)
    return (values % 251).to(dtype) if dtype == th.uint8 else values.to(dtype)


def windows_of(image: np.ndarray, height: int, width: int) -> dict[tuple[int, int], np.ndarray]:
    """Every window of one image (channels, rows, columns), by its upper left corner."""
    _, rows, columns = image.shape
    return {
        (top, left): image[:, top : top + height, left : left + width]
        for top in range(rows - height + 1)
        for left in range(columns - width + 1)
    }


def corners_of(images: np.ndarray, cut: np.ndarray) -> list[tuple[int, int]]:
    """Where each cut stands in its image; all channels have to come from one corner."""
    corners = []
    for image, part in zip(images, cut, strict=True):
        (corner,) = [at for at, window in windows_of(image, *part.shape[1:]).items() if np.array_equal(window, part)]
        corners.append(corner)
    return corners


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("height, width, size", [(8, 8, 5), (6, 9, 4), (5, 5, 5), (7, 5, 5)])
def test_random_crop_gives_windows_of_the_input(height: int, width: int, size: int, dtype: th.dtype) -> None:
    th.manual_seed(0)
    images = pictures(7, 6, height, width, dtype)
    before = images.clone()
    cropped = random_crop(images, size)
    assert cropped.shape == (7, 6, size, size) and cropped.dtype == dtype
    corners_of(images.numpy(), cropped.numpy())
    assert th.equal(images, before)


def test_random_crop_is_uniform_over_all_positions_and_independent_over_images() -> None:
    th.manual_seed(1)
    images = pictures(1, 2, 5, 6).expand(4800, -1, -1, -1)
    corners = corners_of(images.numpy(), random_crop(images, 3).numpy())
    counts = np.zeros((3, 4))
    for corner in corners:
        counts[corner] += 1
    assert counts.sum() == 4800
    # Chi-square, 11 degrees of freedom: 31.3 is passed once in a thousand.
    assert ((counts - 400) ** 2 / 400).sum() < 31.3
    # Each image draws a corner of its own: neighbours in the batch agree as often as chance has it.
    alike = np.mean([one == other for one, other in itertools.pairwise(corners)])
    assert alike == pytest.approx(1 / 12, abs=0.02)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("height, width, pad", [(7, 7, 2), (5, 8, 3), (6, 6, 0)])
def test_random_shift_cuts_the_padded_picture(height: int, width: int, pad: int, dtype: th.dtype) -> None:
    th.manual_seed(2)
    images = pictures(8, 4, height, width, dtype)
    shifted = random_shift(images, pad)
    assert shifted.shape == images.shape and shifted.dtype == dtype
    padded = np.pad(images.numpy(), ((0, 0), (0, 0), (pad, pad), (pad, pad)), mode="edge")
    corners_of(padded, shifted.numpy())
    if pad == 0:
        assert th.equal(shifted, images)


def test_random_shift_reaches_every_shift() -> None:
    th.manual_seed(3)
    images = pictures(1, 3, 6, 6).expand(1000, -1, -1, -1)
    padded = np.pad(images.numpy(), ((0, 0), (0, 0), (2, 2), (2, 2)), mode="edge")
    corners = corners_of(padded, random_shift(images, 2).numpy())
    assert set(corners) == {(top, left) for top in range(5) for left in range(5)}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "height, width, size, corner", [(100, 100, 84, (8, 8)), (8, 6, 4, (2, 1)), (7, 8, 4, (1, 2)), (5, 5, 5, (0, 0))]
)
def test_center_crop(height: int, width: int, size: int, corner: tuple[int, int], dtype: th.dtype) -> None:
    images = pictures(2, 3, height, width, dtype)
    cropped = center_crop(images, size)
    expected = images.numpy()[:, :, corner[0] : corner[0] + size, corner[1] : corner[1] + size]
    np.testing.assert_array_equal(cropped.numpy(), expected)
    assert cropped.dtype == dtype


def test_default_sizes_are_the_papers() -> None:
    images = pictures(2, 9, 100, 100, th.uint8)
    assert random_crop(images).shape == center_crop(images).shape == (2, 9, 84, 84)


@pytest.mark.parametrize("crop", [random_crop, center_crop])
@pytest.mark.parametrize("shape", [(2, 3, 83, 84), (2, 3, 84, 83), (3, 84, 84)])
def test_images_that_are_too_small(crop, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"cannot crop images of shape \(.*\) .* to 84 x 84") as error:
        crop(th.zeros(shape), 84)
    assert str(shape) in str(error.value)
