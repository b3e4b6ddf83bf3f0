"""Care for stores: garbage, pins, repairs, copies, lineage and what a change would compute again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.configuration import load_configuration
from flows.pipeline.definition import PIPELINE
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from flows.reconstruction.run_records import FinishedRun, list_runs, summarise_run, write_run_record
from flows.upkeep.garbage import find_garbage
from flows.upkeep.pins import add_pin, list_pins, remove_pin
from flows.upkeep.repair import repair_artifacts
from flows.upkeep.store_copy import copy_store
from flows.upkeep.what_if import find_recomputations
from genre_tasks.errors import ArtifactCorruptError, ConfigError, GenreError, InputError, TransientIOError
from storage.local import LocalStore
from storage.manifest import NewerSchemaError
from tests.contracts.store_suite import address
from tests.faults.small_run import LOG, SETTINGS
from tests.storage.artifact_values import make

LATER = datetime.now(UTC) + timedelta(days=2)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with one run of one chunk, and its record."""
    store = tmp_path_factory.mktemp("filled") / "store"
    config = load_configuration("demo", settings=SETTINGS).model_dump(mode="json")
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        refs[spec.name] = run_stage(spec.name, Job(LOG, 0, str(store), config), refs)
    run = FinishedRun(log=LOG, preset="demo", store=str(store), config=config, differs={}, chunks={0: refs})
    write_run_record(run, summarise_run(run), {})
    return store


@pytest.fixture
def store(filled: Path, tmp_path: Path) -> LocalStore:
    return LocalStore(shutil.copytree(filled, tmp_path / "store"))


@pytest.fixture
def genre(store: LocalStore) -> Callable[..., tuple[int, str]]:
    """The command; its exit status and its output."""

    def call(*words: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, [*words, "--store", store.uri])
        if isinstance(done.exception, GenreError):
            return 2, str(done.exception)
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done.exit_code, done.stdout

    return call


def record_of(store: LocalStore) -> dict[str, object]:
    (record,) = list_runs(store.uri)
    return {**record, "store": store.uri}


def test_what_a_run_refers_to_is_no_garbage(store: LocalStore) -> None:
    stray = store.commit(address(), "evaluation", make("evaluation"))
    imported = address()
    imported = type(imported)("imported", "scene", 0, "import", "c" * 64)
    store.commit(imported, "evaluation", make("evaluation"))
    found = find_garbage(store, now=LATER)
    assert [artifact.address for artifact in found.artifacts] == [stray.address]
    assert found.kept == len(PIPELINE) + 1 and found.young == 0
    # A run that goes on has no record yet.
    assert find_garbage(store).artifacts == () and find_garbage(store).young == 1


def test_a_pin_keeps_what_its_artifact_was_made_from(store: LocalStore) -> None:
    store.records.remove(f"runs/{record_of(store)['run']}")
    (fnet,) = store.artifacts(stage="fnet")
    pin = add_pin(store, fnet.address.key[:10], "kept")
    assert [p.note for p in list_pins(store)] == ["kept"] and pin.keys == (fnet.address.key,)
    gone = {artifact.address.stage for artifact in find_garbage(store, now=LATER).artifacts}
    assert gone == {"enet", "evaluate/initial", "evaluate/gnet", "evaluate/enet", "evaluate/fnet"}
    remove_pin(store, pin.name[:6])
    assert len(find_garbage(store, now=LATER).artifacts) == len(PIPELINE)
    with pytest.raises(InputError, match="0 pins"):
        remove_pin(store, pin.name)


def test_a_damaged_record_keeps_everything(store: LocalStore, genre: Callable[..., tuple[int, str]]) -> None:
    (store.root / "runs" / str(record_of(store)["run"]) / "run.json").write_text("{")
    code, text = genre("gc", "--delete", "--older-than", "0")
    assert code == 2 and "run.json" in text and len(list(store.artifacts())) == len(PIPELINE)


def test_gc_changes_nothing_unless_asked(store: LocalStore, genre: Callable[..., tuple[int, str]]) -> None:
    store.commit(address(), "evaluation", make("evaluation"))
    code, text = genre("gc", "--older-than", "0")
    assert code == 0 and "Nothing was changed" in text and store.find(address()) is not None
    code, text = genre("gc", "--older-than", "0", "--delete", "--json")
    assert code == 0 and json.loads(text)["artifacts"] == [str(address())]
    assert store.find(address()) is None and len(list(store.artifacts())) == len(PIPELINE)


def test_pins_by_command(store: LocalStore, genre: Callable[..., tuple[int, str]]) -> None:
    run = str(record_of(store)["run"])
    assert genre("pin", run[:5], "--note", "why")[0] == 0
    assert "why" in genre("pin", "--list")[1]
    assert genre("pin")[0] == 2 and genre("unpin", run[:5])[0] == 0 and list_pins(store) == []


def test_damage_is_repaired_to_the_byte(store: LocalStore, genre: Callable[..., tuple[int, str]]) -> None:
    before = {artifact.address: artifact.manifest.payload_digest for artifact in store.artifacts()}
    run = record_of(store)["run"]
    (gnet,) = store.artifacts(stage="gnet")
    (effects,) = store.artifacts(stage="effects")
    stray = store.commit(address(), "evaluation", make("evaluation"))
    for file in (next(gnet.path.glob("*.parquet")), effects.path / "manifest.json", stray.path / "metrics.parquet"):
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 4
        file.write_bytes(data)
    assert genre("verify")[0] == 1
    code, text = genre("verify", "--repair")
    assert code == 1 and text.count("repaired: ") == 2 and "no run refers to it" in text
    assert {artifact.address: artifact.manifest.payload_digest for artifact in store.artifacts()} == before
    assert record_of(store)["run"] == run
    assert genre("verify")[0] == 0


def test_a_copy_has_the_same_bytes_and_is_resumed(store: LocalStore, tmp_path: Path) -> None:
    target = LocalStore(tmp_path / "target")
    first = next(store.artifacts())
    target.adopt(first.manifest, first.path)
    result = copy_store(store, target)
    assert (result.copied, result.skipped, result.records) == (len(PIPELINE) - 1, 1, 1)
    assert [a.manifest for a in target.artifacts()] == [a.manifest for a in store.artifacts()]
    assert [damage for _, damage in target.verify_all()] == [None] * len(PIPELINE)
    (record,) = list_runs(target.uri)
    assert record["store"] == target.uri and Path(record["report"]).is_file() and target.uri in record["report"]
    again = copy_store(store, target)
    assert (again.copied, again.skipped) == (0, len(PIPELINE))


def test_one_run_is_copied_without_the_rest(store: LocalStore, tmp_path: Path) -> None:
    store.commit(address(), "evaluation", make("evaluation"))
    target = LocalStore(tmp_path / "target")
    assert copy_store(store, target, runs=[str(record_of(store)["run"])[:6]]).copied == len(PIPELINE)
    assert target.find(address()) is None


def test_a_copy_says_what_it_could_not_read(store: LocalStore, tmp_path: Path) -> None:
    (gnet,) = store.artifacts(stage="gnet")
    (gnet.path / "manifest.json").write_text("{")
    target = LocalStore(tmp_path / "target")
    for runs in ((), (str(record_of(store)["run"]),)):
        with pytest.raises(InputError, match=f"1 artifacts .* such as {gnet.address.key[:12]}; all else is copied"):
            copy_store(store, target, runs=runs)
    # A run is copied with ancestors, so that only what was made from the damaged one needs it.
    assert len(list(target.artifacts())) == len(PIPELINE) - 1


def test_what_a_damaged_pin_needs_is_no_garbage(store: LocalStore) -> None:
    (fnet,) = store.artifacts(stage="fnet")
    add_pin(store, fnet.address.key[:10])
    store.records.remove(f"runs/{record_of(store)['run']}")
    (fnet.path / "manifest.json").write_text("{")
    with pytest.raises(InputError, match=r"pins is damaged or gone.*genre unpin"):
        find_garbage(store, now=LATER)


def test_an_edited_run_whose_recorded_run_is_gone_keeps_everything(store: LocalStore) -> None:
    record = record_of(store)
    edited = {**record, "run": "e" * 12, "edited": {"run": record["run"], "edits": {"edits": []}}}
    folder = store.root / "runs" / ("e" * 12)
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps(edited))
    assert find_garbage(store, now=LATER).artifacts == ()
    store.records.remove(f"runs/{record['run']}")
    with pytest.raises(InputError, match=r"is edited from run .*, whose record is gone"):
        find_garbage(store, now=LATER)


def test_a_file_that_cannot_be_read_hides_no_damage(store: LocalStore, genre: Callable[..., tuple[int, str]]) -> None:
    first, *_, last = sorted(store.artifacts(), key=lambda artifact: str(artifact.path))
    payload = next(path for path in first.path.iterdir() if path.name != "manifest.json")
    payload.unlink()
    payload.mkdir()  # reading a folder is an error of the system, as a bad sector is
    (last.path / "manifest.json").write_text("{")
    code, text = genre("verify")
    assert code == 1 and text.count("damaged: ") == 2
    assert "repaired: " in genre("verify", "--repair")[1]


def test_what_cannot_be_read_or_is_newer_is_no_damage(
    genre: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = (None, TransientIOError, NewerSchemaError)
    faults = [(str(kind), None if kind is None else kind("not now", remedy="Wait.")) for kind in kinds]
    monkeypatch.setattr(LocalStore, "verify_all", lambda _: iter(faults))
    code, text = genre("verify")
    assert code == 1 and "1 artifacts are sound, 0 damaged, 1 unreadable, 1 of a newer version" in text
    assert "damaged: " not in text and "--repair" not in text
    code, text = genre("verify", "--repair")
    assert code == 1 and text.count("left: ") == 2


def test_damage_is_not_copied_and_all_else_is(store: LocalStore, tmp_path: Path) -> None:
    (gnet,) = store.artifacts(stage="gnet")
    next(gnet.path.glob("*.parquet")).write_bytes(b"else")
    target = LocalStore(tmp_path / "target")
    with pytest.raises(ArtifactCorruptError, match=r"1 artifacts are damaged, and all else is copied.*parquet"):
        copy_store(store, target)
    assert target.find(gnet.address) is None
    assert len(list(target.artifacts())) == len(PIPELINE) - 1 and len(list_runs(target.uri)) == 1


def add_damaged_record(store: LocalStore) -> None:
    folder = store.root / "runs" / ("d" * 12)
    folder.mkdir()
    (folder / "run.json").write_text("{")


def test_a_damaged_record_is_left_out_of_a_copy_and_all_else_is_copied(store: LocalStore, tmp_path: Path) -> None:
    run = record_of(store)["run"]
    add_damaged_record(store)
    target = LocalStore(tmp_path / "target")
    with pytest.raises(InputError, match=r"1 records are damaged, and all else is done.*d{12}/run\.json"):
        copy_store(store, target)
    assert len(list(target.artifacts())) == len(PIPELINE)
    # The damaged one would make this an error.
    assert [record["run"] for record in list_runs(target.uri)] == [run]


@pytest.mark.parametrize("pinned", [False, True])
def test_a_damaged_pin_is_left_out_of_a_copy_and_all_else_is_copied(
    store: LocalStore, tmp_path: Path, pinned: bool
) -> None:
    run = record_of(store)["run"]
    add_pin(store, run)
    (store.root / "pins" / ("d" * 12)).mkdir()
    (store.root / "pins" / ("d" * 12) / "pin.json").write_text("{")
    target = LocalStore(tmp_path / "target")
    with pytest.raises(
        InputError, match=r"1 records are damaged, and all else is done.*pin is damaged.*d{12}/pin\.json"
    ):
        copy_store(store, target, pinned=pinned)
    assert len(list(target.artifacts())) == len(PIPELINE) and len(list_runs(target.uri)) == 1
    assert [pin.name for pin in list_pins(target)] == [run]


def test_a_copy_leaves_newer_records_of_the_target(store: LocalStore, tmp_path: Path) -> None:
    target = LocalStore(tmp_path / "target")
    copy_store(store, target)
    name = f"runs/{record_of(store)['run']}"
    newer = json.loads((target.root / name / "run.json").read_text()) | {"store": "elsewhere", "status": "partly_done"}
    (target.root / name / "run.json").write_text(json.dumps(newer))
    (target.root / name / "report.html").write_text("newer")
    (store.root / name / "more.txt").write_text("more")
    assert copy_store(store, target).records == 1
    assert json.loads((target.root / name / "run.json").read_text()) == newer
    assert (target.root / name / "report.html").read_text() == "newer"
    assert (target.root / name / "more.txt").read_text() == "more"
    # What a stopped copy lacks is copied with its new place.
    (target.root / name / "run.json").unlink()
    assert copy_store(store, target).records == 1 and list_runs(target.uri)[0]["store"] == target.uri
    assert copy_store(store, target).records == 0


def test_a_copy_puts_back_what_was_removed_before_the_records_came(store: LocalStore, tmp_path: Path) -> None:
    target = LocalStore(tmp_path / "target")
    removed = []

    def remove_garbage(done: int, total: int, bytes_copied: int) -> None:
        if done == total and not removed:
            removed.extend(find_garbage(target, now=LATER).artifacts)
            for artifact in removed:
                target.discard(artifact)

    copy_store(store, target, report=remove_garbage)
    assert len(removed) == len(list(target.artifacts())) == len(PIPELINE)


def test_a_repair_goes_on_past_a_damaged_record(store: LocalStore) -> None:
    run = record_of(store)["run"]
    add_damaged_record(store)
    (gnet,) = store.artifacts(stage="gnet")
    stray = store.commit(address(), "evaluation", make("evaluation"))
    for artifact in (gnet, stray):
        next(artifact.path.glob("*.parquet")).write_bytes(b"else")
    damage = {name: error for name, error in store.verify_all() if error is not None}
    again: list[object] = []
    found = {}
    with pytest.raises(InputError, match=r"1 records are damaged, and all else is done.*d{12}/run\.json"):
        for repair in repair_artifacts(store, damage, lambda record: again.append(record["run"])):
            found[repair.name] = repair.why
    assert again == [run] and store.find(gnet.address) is None and len(found) == 2
    assert found[str(stray.address.relative_path)] == "no run whose record can be read refers to it"


def test_a_repair_leaves_what_has_become_sound_meanwhile(store: LocalStore) -> None:
    (gnet,) = store.artifacts(stage="gnet")
    damage: dict[str, GenreError] = {str(gnet.address.relative_path): ArtifactCorruptError("was damaged", remedy="")}
    again: list[object] = []
    (repair,) = repair_artifacts(store, damage, again.append)
    assert repair.outcome == "repaired" and again == []
    store.verify(gnet)


@pytest.mark.parametrize(
    ("change", "own", "reading"),
    [
        ("gnet.iterations=5", {"gnet"}, {"novel_views", "fnet", "enet", "evaluate/gnet"}),
        ("code:genre_tasks.stages.fnet", {"fnet"}, {"enet", "evaluate/fnet", "evaluate/enet"}),
        ("weights:fnet", {"fnet"}, {"enet", "evaluate/fnet", "evaluate/enet"}),
        ("weights:enet", {"gnet", "enet"}, {"novel_views", "fnet", "evaluate/gnet"}),
        ("log", {"ingest", "effects"}, {"initial", "gnet", "enet"}),
        ("package:torch", {"gnet", "fnet", "enet"}, set()),
        ("gnet.iterations=2", set(), set()),
    ],
)
def test_a_change_says_what_it_computes_again(store: LocalStore, change: str, own: set[str], reading: set[str]) -> None:
    record = record_of(store)
    if not own:
        change = f"gnet.iterations={record['config']['gnet']['iterations']}"  # type: ignore[index]
    found = find_recomputations(record, change)
    reasons = {entry.stage: entry.reason for entry in found}
    assert own <= {stage for stage, reason in reasons.items() if not reason.startswith("reads ") or change == "log"}
    assert reading <= set(reasons)
    assert bool(found) == bool(own)


def test_a_setting_says_what_a_run_computes(store: LocalStore) -> None:
    """What is foretold is what the pipeline then does."""
    record = record_of(store)
    foretold = {entry.stage for entry in find_recomputations(record, "evaluate.every=3")}
    config = load_configuration("demo", settings=[*SETTINGS, "evaluate.every=3"]).model_dump(mode="json")
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        refs[spec.name] = run_stage(spec.name, Job(LOG, 0, store.uri, config), refs)
    assert {name for name, ref in refs.items() if not ref.cached} == foretold


def test_changes_that_keys_do_not_know_are_refused(store: LocalStore) -> None:
    for change in (
        "nothing",
        "code:",
        "gnet",
        "code:genre_tasks.none",
        "weights:fnett",
        "package:yaml",
        "iterations=3",
    ):
        with pytest.raises(ConfigError, match="no change that keys know"):
            find_recomputations(record_of(store), change)


def test_lineage_goes_both_ways(store: LocalStore, genre: Callable[..., tuple[int, str]]) -> None:
    (gnet,) = store.artifacts(stage="gnet")
    values = json.loads(genre("lineage", gnet.address.key[:12], "--json")[1])
    assert {row["stage"] for row in values["made_from"]} == {"ingest", "effects", "initial"}
    assert {row["stage"] for row in values["went_into"]} >= {"novel_views", "fnet", "enet", "evaluate/gnet"}
    code, text = genre("lineage", str(record_of(store)["run"]), "--if", "weights:fnet")
    assert code == 0 and "its weights" in text
    assert genre("lineage", "zz")[0] == 2
