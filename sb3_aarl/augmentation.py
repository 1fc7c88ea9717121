"""Image augmentation on tensors: random crop (CURL, the paper's table 7), random shift (DrQ), centre crop."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from torch.nn import functional as F

AUGMENTATIONS = ("auto", "random_crop", "random_shift", "none")
CROP_SIZE = 84  # paper, table 7


def _check_crop(images: th.Tensor, size: int) -> None:
    if images.ndim != 4 or min(images.shape[2:]) < size:
        raise ValueError(
            f"cannot crop images of shape {tuple(images.shape)} (batch, channels, height, width) to {size} x {size}"
        )


def cut(images: th.Tensor, numbers: th.Tensor, top: th.Tensor, left: th.Tensor, height: int, width: int) -> th.Tensor:
    """
    Parts of images, (..., channels, height, width), without a copy of the images that they are cut from.

    :param images: (n, channels, rows, columns)
    :param numbers: Of the images, (...); first row and column ``top`` and ``left`` of each part broadcast to it
    :param height: Rows of each part
    :param width: Columns of each part
    """
    _, channels, n_rows, n_columns = images.shape
    channel, row = (th.arange(length, device=images.device) for length in (channels, height))
    rows = ((numbers[..., None] * channels + channel)[..., None] * n_rows + row) * n_columns
    starts = rows + (top * n_columns + left)[..., None, None]
    pixels = images.flatten().unfold(0, width, 1)  # as many as are in a row of a part, from each one on; nothing is copied
    return pixels.index_select(0, starts.flatten()).view(*numbers.shape, channels, height, width)


def random_crop(images: th.Tensor, size: int = 84) -> th.Tensor:
    """
    Crop every image to ``size`` x ``size`` at a random position of its own; the frames of a stack stay together.

    :param images: (batch, channels, height, width), any dtype
    :param size: Height and width in pixels of what is kept
    :raises ValueError: when the images are smaller
    """
    _check_crop(images, size)
    batch, _, height, width = images.shape
    if height == width == size:
        return images
    top = th.randint(height - size + 1, (batch,), device=images.device)
    left = th.randint(width - size + 1, (batch,), device=images.device)
    return cut(images, th.arange(batch, device=images.device), top, left, size, size)


def random_shift(images: th.Tensor, pad: int = 4) -> th.Tensor:
    """
    Shift every image by up to ``pad`` pixels each way, its border repeated, as in DrQ.

    :param images: (batch, channels, height, width), any dtype; the shape is kept
    :param pad: Largest shift in pixels
    """
    batch, _, height, width = images.shape
    # Replicate padding does not support integers; pixels are exact in float32.
    padded = F.pad(images.float(), (pad,) * 4, mode="replicate").to(images.dtype)
    top, left = th.randint(2 * pad + 1, (2, batch), device=images.device)
    return cut(padded, th.arange(batch, device=images.device), top, left, height, width)


def center_crop(images: th.Tensor, size: int = 84) -> th.Tensor:
    """
    The middle ``size`` x ``size`` of every image.

    :param images: (batch, channels, height, width), any dtype
    :param size: Height and width in pixels of what is kept
    :raises ValueError: when the images are smaller
    """
    _check_crop(images, size)
    top, left = ((length - size) // 2 for length in images.shape[2:])
    return images[:, :, top : top + size, left : left + size]


def image_spaces(space: spaces.Space, normalized_image: bool = False) -> dict[str, spaces.Box]:
    """
    The images among observations by key, which is empty where observations are not a Dict. ``normalized_image``: whether they
    need not be bytes (SB3's ``normalize_images=False``).
    """
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    boxes = {key: part for key, part in parts.items() if isinstance(part, spaces.Box)}
    return {key: part for key, part in boxes.items() if is_image_space(part, normalized_image=normalized_image)}


def cropped_space(space: spaces.Space, size: int, normalized_image: bool) -> spaces.Space:
    """The observation space after images were cropped to ``size`` x ``size``."""
    images = image_spaces(space, normalized_image)
    cropped = {
        key: spaces.Box(box.low[:, :size, :size], box.high[:, :size, :size], dtype=box.dtype)  # type: ignore[arg-type]
        for key, box in images.items()
    }
    if isinstance(space, spaces.Dict):
        return spaces.Dict({**space.spaces, **cropped})
    return cropped.get("", space)


def resolve_augmentation(
    augmentation: str, space: spaces.Space, crop_size: int | None, normalized_image: bool
) -> tuple[str, int | None]:
    """What ``augmentation`` means for these observations: ``random_crop`` and its size, ``random_shift`` or ``none``."""
    if augmentation not in AUGMENTATIONS:
        raise ValueError(f"unknown augmentation {augmentation!r}, expected one of {', '.join(AUGMENTATIONS)}")
    sizes = {key: box.shape[1:] for key, box in image_spaces(space, normalized_image).items()}
    if not sizes:
        return "none", None
    if augmentation == "auto":
        augmentation = "random_shift" if crop_size is None else "random_crop"
    if augmentation != "random_crop":
        return augmentation, None
    crop_size = CROP_SIZE if crop_size is None else crop_size
    for key, size in sizes.items():
        if min(size) < crop_size:
            raise ValueError(
                f"images{f' under {key!r}' if key else ''} of {size[0]} x {size[1]} pixels are smaller than the crop of "
                f"{crop_size} x {crop_size}: render them larger, or pass augmentation='random_shift'"
            )
    return augmentation, crop_size
