"""The 80 classes of COCO's objects, in the order in which detectors number them."""

from __future__ import annotations

from genre_tasks.errors import InputError

COCO_CLASSES = (
    *("person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light"),
    *("fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow"),
    *("elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee"),
    *("skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard"),
    *("tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple"),
    *("sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch"),
    *("potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard", "cell phone"),
    *("microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors", "teddy bear"),
    *("hair drier", "toothbrush"),
)
"""Names of the classes; the index is the class's number."""

ROAD_USERS = ("person", "bicycle", "car", "motorcycle", "bus", "truck")
"""Those of them that take part in traffic and that driving logs annotate."""


def find_road_users(class_names: tuple[str, ...]) -> tuple[int, ...]:
    """Finds the classes of road users among a detector's classes.

    Args:
        class_names: the detector's names, in the order of their numbers.

    Returns:
        The numbers of the classes that are named as in ``ROAD_USERS``, in rising order.

    >>> find_road_users(("tree", "car", "Person"))
    (1, 2)
    """
    return tuple(index for index, name in enumerate(class_names) if name.strip().lower() in ROAD_USERS)


def require_road_users(class_names: tuple[str, ...], detector: str) -> None:
    """Refuses a detector that knows no road users: it would find none on recorded images either.

    Args:
        class_names: the detector's names.
        detector: its file or name, for the error.

    Raises:
        InputError: no class is one of ``ROAD_USERS``.
    """
    if not find_road_users(class_names):
        remedy = f"Give one with a class of these: {', '.join(ROAD_USERS)}."
        raise InputError("the detector knows no road users", remedy=remedy, file=detector)
