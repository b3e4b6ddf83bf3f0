"""Names what lies in a sequence folder and is not read, with what was expected in its place.

Whether it matters depends on what is missing: a file of an unknown name beside complete images is a note, beside
missing ones a warning, since it may be what is missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from genre_tasks.logs.findings import Finding, format_frames
from genre_tasks.logs.pandaset.folder_index import FrameFolder, SequenceIndex
from genre_tasks.logs.pandaset.layout import frame_stem

_MAX_NAMES_LISTED = 4
_MAX_NAME_CHARACTERS = 60
# PandaSet has these too, and they are not needed.
_KNOWN_UNREAD = frozenset({"meta/", "semseg/"})
_DOCUMENTS = ("readme", "license", "licence", "changelog", "citation")
# What people call the folders whose names the layout fixes.
_CUBOID_WORDS = ("cuboid", "annot", "label", "box", "track", "object")
_EXPECTED = {
    ".": "camera/, lidar/ and annotations/cuboids/",
    "camera": "a folder for each camera, such as camera/front_camera/",
    "annotations": "annotations/cuboids/",
}
_CAMERA_WORDS = ("cam", "image", "img", "rgb", "jpg", "png")


def find_unread_files(index: SequenceIndex, frame_count: int) -> tuple[Finding, ...]:
    """Names what is in a sequence folder and not read, and what is read under another name than expected.

    Args:
        index: the folder.
        frame_count: frames of the log, which ``lidar/poses.json`` says.

    Returns:
        Nothing for a folder as PandaSet has it.
    """
    findings = [*_check_folders(index), *_check_frames(index.lidar, "lidar", frame_count, None)]
    for name, folder in index.cameras.items():
        where = folder.path.relative_to(index.root).as_posix()
        if "intrinsics.json" in folder.settings:
            findings += _check_frames(folder, where, frame_count, name)
        else:
            findings.append(_report_no_intrinsics(folder, where, name))
    findings += _check_frames(index.cuboids, "annotations/cuboids", frame_count, None)
    findings += _check_cuboid_gaps(index.cuboids, frame_count)
    return tuple(findings)


def _check_folders(index: SequenceIndex) -> Iterator[Finding]:
    """What is odd about the folders above the frames."""
    for found, expected in index.respelled:
        yield Finding("other_capitals", "note", f"the folder {found} is read as {expected}", f"Rename it {expected}.")
    for folder, reason in index.unlistable:
        message = f"the folder {folder} cannot be listed ({reason})"
        yield Finding("unreadable_folder", "warning", message, "Make it readable for this user.")
    missing_words = (*(_CUBOID_WORDS if not index.cuboids.files else ()), *(_CAMERA_WORDS if not index.cameras else ()))
    for folder, entries in index.unread.items():
        names = [name for name in entries if name not in _KNOWN_UNREAD and not name.lower().startswith(_DOCUMENTS)]
        if not names:
            continue
        matters = {
            ".": any(word in name.lower() for name in names for word in missing_words),
            "camera": not index.cameras,
            "annotations": not index.cuboids.files,
        }
        where = "the sequence folder" if folder == "." else folder
        message = f"not read in {where}: {_list_names(names)}; expected: {_EXPECTED[folder]}"
        numbers = {"files": len(names)}
        if matters[folder]:
            yield Finding("unread_files", "warning", message, "Rename what belongs to the log.", numbers)
        else:
            yield Finding("unread_files", "note", message, numbers=numbers)


def _report_no_intrinsics(folder: FrameFolder, where: str, camera: str) -> Finding:
    count = len(folder.files)
    message = f"{where} has {count} images and no intrinsics.json, and is left out"
    remedy = "Add intrinsics.json with fx, fy, cx and cy in pixels, or remove the folder."
    return Finding("camera_without_intrinsics", "warning", message, remedy, {"images": count}, camera)


def _check_frames(folder: FrameFolder, where: str, frame_count: int, camera: str | None) -> Iterator[Finding]:
    """What is odd about the names of files that belong to frames."""
    last = frame_count - 1
    outside = [frame for frame in folder.files if frame > last]
    if frame_count > 1 and outside == [frame_count] and 0 not in folder.files and 2 * len(folder.files) > frame_count:
        message = f"the files in {where} are numbered from 1 to {frame_count}, but frames count from 0 to {last}"
        remedy = f"Rename them, so that the first is {frame_stem(0)}: each would be taken for the next frame."
        yield Finding("counted_from_one", "fatal", message, remedy, {"frames": frame_count}, camera)
    elif outside:
        message = f"the files {format_frames(outside)} in {where} have no frame: lidar/poses.json has 0 to {last}"
        remedy = "Copy lidar/poses.json again, or number the files by frame; they are left out."
        numbers = {"files": len(outside), "frames": frame_count}
        yield Finding("files_without_frame", "warning", message, remedy, numbers, camera)
    rivals = {frame: names for frame, names in folder.rivals.items() if frame <= last}
    if rivals:
        first = min(rivals)
        message = f"two files for frames {format_frames(sorted(rivals))} in {where}: {folder.files[first].name} is read"
        message += f", {_list_names(rivals[first])} is not"
        yield Finding("ambiguous_file", "warning", message, "Remove one of them.", {}, camera, tuple(sorted(rivals)))
    missing = [frame for frame in range(frame_count) if frame not in folder.files]
    if folder.unread:
        kind = "pkl.gz" if camera is None else "jpg"
        message = f"{len(folder.unread)} files are not read in {where}: {_list_names(folder.unread)}"
        message += f"; expected: {frame_stem(0)}.{kind} to {frame_stem(last)}.{kind}"
        numbers = {"files": len(folder.unread), "missing_frames": len(missing)}
        if not missing:
            yield Finding("unread_files", "note", message, numbers=numbers, camera=camera)
        else:
            remedy = "Rename or convert them, if they are the frames that are missing."
            yield Finding("unread_files", "warning", message, remedy, numbers, camera)


def _check_cuboid_gaps(folder: FrameFolder, frame_count: int) -> Iterator[Finding]:
    missing = tuple(frame for frame in range(frame_count) if frame not in folder.files)
    if missing and len(missing) < frame_count:
        message = f"no cuboids at frames {format_frames(missing)}, though other frames have them"
        remedy = "Copy annotations/cuboids again; objects are taken to be where their other boxes say."
        yield Finding("missing_cuboids", "warning", message, remedy, {"frames": len(missing)}, None, missing)


def _list_names(names: Iterable[str]) -> str:
    listed = list(names)
    more = len(listed) - _MAX_NAMES_LISTED
    shortened = [
        name if len(name) <= _MAX_NAME_CHARACTERS else f"{name[: _MAX_NAME_CHARACTERS // 2]}…{name[-8:]}"
        for name in listed[:_MAX_NAMES_LISTED]
    ]
    return ", ".join(shortened) + (f" and {more} more" if more > 0 else "")
