"""Two artifacts of one kind side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flows.comparison.comparison import Comparison
from flows.comparison.gaussian_differences import compare_gaussians
from flows.comparison.metric_differences import Score, compare_scores
from flows.comparison.picture_pairs import pair_pictures
from flows.comparison.setting_differences import list_differences
from genre_tasks.errors import InputError
from storage.lineage import summarise_files

if TYPE_CHECKING:
    from storage.store import Artifact, Store

_STATISTICS = ("min", "mean", "max")


def compare_artifacts(stores: tuple[Store, Store], a: Artifact, b: Artifact) -> Comparison:
    """Compares two artifacts: where they are from, settings, files, statistics, and what their kind has.

    Args:
        stores: that hold A and B.
        a: any artifact.
        b: another one of the same kind.

    Returns:
        The comparison.

    Raises:
        InputError: the artifacts are of different kinds.
        ArtifactCorruptError: a file of either is damaged.
    """
    kinds = (a.manifest.kind, b.manifest.kind)
    if kinds[0] != kinds[1]:
        raise InputError(
            f"A is of the kind {kinds[0]}, and B of the kind {kinds[1]}", remedy="Compare artifacts of one kind."
        )
    for store, artifact in zip(stores, (a, b), strict=True):
        store.verify(artifact)
        store.fetch(artifact)
    comparison = Comparison(a=_name(a), b=_name(b))
    if a.manifest.payload_digest == b.manifest.payload_digest:
        comparison.notes.append("The payloads are the same, byte by byte.")
    comparison.add_table("artifacts", _compare_manifests(a, b))
    settings = list_differences(a.manifest.configuration, b.manifest.configuration)
    comparison.add_table("settings", settings, if_empty="The settings of the stage are the same.")
    if a.manifest.payload_digest == b.manifest.payload_digest:
        return comparison
    comparison.add_table("files", _compare_files(a, b))
    comparison.add_table("statistics", _compare_statistics(stores, a, b))
    _add_contents(comparison, a, b)
    return comparison


def read_scores(artifact: Artifact) -> dict[str, Score]:
    """Reads the metrics of an evaluation, with counts of images as ``…/n``.

    Args:
        artifact: of the kind ``evaluation`` or ``rollout_scores``.

    Returns:
        By the metric's name.

    Raises:
        ArtifactCorruptError: the table is damaged.
    """
    from storage.codecs.evaluation import METRICS
    from storage.codecs.tables import read_rows

    scores: dict[str, Score] = {}
    for row in read_rows(artifact.path / "metrics.parquet", METRICS):
        has_interval = row["low"] is not None and row["high"] is not None
        scores[row["name"]] = Score(row["value"], (row["low"], row["high"]) if has_interval else None)
        scores[row["name"].rpartition("/")[0] + "/n"] = Score(float(row["n"]))
    return scores


def _add_contents(comparison: Comparison, a: Artifact, b: Artifact) -> None:
    kind = a.manifest.kind
    if kind in ("evaluation", "rollout_scores"):
        comparison.add_table("metrics", compare_scores(read_scores(a), read_scores(b)))
    if kind == "reconstruction":
        comparison.add_table("Gaussians", compare_gaussians(a.path, b.path))
    if kind == "effects":
        comparison.add_table("effects", _compare_plans(a, b), if_empty="Both plans decide the same.")
    if a.manifest.log != b.manifest.log or a.manifest.chunk != b.manifest.chunk:
        comparison.notes.append("The artifacts are of different chunks, so no images are compared.")
        return
    comparison.pairs += pair_pictures(a, b)


def _name(artifact: Artifact) -> str:
    manifest = artifact.manifest
    return f"{manifest.log} chunk {manifest.chunk} {manifest.stage} {manifest.key[:12]}"


def _compare_manifests(a: Artifact, b: Artifact) -> list[dict[str, Any]]:
    names = ("log", "chunk", "stage", "key", "payload_digest", "code_digest", "weights_digest", "seconds", "peak_mib")
    rows = [_manifest_row(name, getattr(a.manifest, name), getattr(b.manifest, name)) for name in names]
    inputs = (a.manifest.inputs, b.manifest.inputs)
    rows += [
        _manifest_row(f"made from {name}", inputs[0].get(name), inputs[1].get(name))
        for name in dict.fromkeys([*inputs[0], *inputs[1]])
    ]
    environments = (a.manifest.environment, b.manifest.environment)
    rows += [
        _manifest_row(name, environments[0].get(name), environments[1].get(name))
        for name in dict.fromkeys([*environments[0], *environments[1]])
        if environments[0].get(name) != environments[1].get(name)
    ]
    return rows


def _manifest_row(name: str, a: Any, b: Any) -> dict[str, Any]:
    shown = ["" if value is None else value[:16] if isinstance(value, str) else value for value in (a, b)]
    return {"": name.replace("_", " "), "A": shown[0], "B": shown[1], "same": "yes" if a == b else "no"}


def _compare_files(a: Artifact, b: Artifact) -> list[dict[str, Any]]:
    files_a = {file.path: file for file in a.manifest.files}
    files_b = {file.path: file for file in b.manifest.files}
    rows: list[dict[str, Any]] = []
    for path in dict.fromkeys([*files_a, *files_b]):
        one = files_a.get(path)
        other = files_b.get(path)
        if one is not None and other is not None and one.sha256 == other.sha256:
            continue
        rows.append(
            {
                "differs": path,
                "bytes A": "" if one is None else one.size,
                "bytes B": "" if other is None else other.size,
            }
        )
    # A folder of images would fill pages; the table of statistics says how much they differ.
    most = 12
    if len(rows) > most:
        rest = f"and {len(rows) - most} more"
        rows = [*rows[:most], {"differs": rest, "bytes A": "", "bytes B": ""}]
    return rows


def _compare_statistics(stores: tuple[Store, Store], a: Artifact, b: Artifact) -> list[dict[str, Any]]:
    """A row for each column of each table of both whose statistics differ."""
    found = [_read_statistics(store, artifact) for store, artifact in zip(stores, (a, b), strict=True)]
    rows = []
    for name in dict.fromkeys([*found[0], *found[1]]):
        one = found[0].get(name, {})
        other = found[1].get(name, {})
        if all(one.get(s) == other.get(s) for s in _STATISTICS):
            continue
        row: dict[str, Any] = {"table": name[0], "column": name[1]}
        for statistic in _STATISTICS:
            row |= {f"{statistic} A": one.get(statistic, ""), f"{statistic} B": other.get(statistic, "")}
        rows.append(row)
    return rows


def _read_statistics(store: Store, artifact: Artifact) -> dict[tuple[str, str], dict[str, Any]]:
    return {
        # Without the number of rows, which stands behind the table's name and may differ.
        (table.name.partition(":")[0], row.get("column", row.get("picture", ""))): row
        for table in summarise_files(store, artifact)
        # Snapshots are scenes on the way, and would repeat the scene's table.
        if not table.name.startswith("snapshots/")
        for row in table.rows
    }


def _compare_plans(a: Artifact, b: Artifact) -> list[dict[str, Any]]:
    from storage.codecs.effects import EFFECTS
    from storage.codecs.tables import read_rows

    plan_a, plan_b = ({r["name"]: r for r in read_rows(x.path / "effects.parquet", EFFECTS)} for x in (a, b))
    return [
        {
            "effect": name,
            "A": plan_a[name]["choice"],
            "B": plan_b[name]["choice"],
            "because A": plan_a[name]["reason"],
            "because B": plan_b[name]["reason"],
        }
        for name in plan_a
        if name in plan_b
        and (plan_a[name]["choice"], plan_a[name]["reason"]) != (plan_b[name]["choice"], plan_b[name]["reason"])
    ]
