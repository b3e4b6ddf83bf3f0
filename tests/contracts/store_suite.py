"""What every store must do. Inherit :class:`StoreSuite` and give the fixture ``store``."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import pytest

from genre_tasks.errors import ArtifactCorruptError, ConfigError, NonFiniteError
from storage.address import Address
from storage.local import LocalStore
from storage.manifest import MANIFEST
from storage.store import Provenance, Store
from tests.storage.artifact_values import COLORS, MAKERS, assert_same, make

KEY, OTHER = "a" * 64, "b" * 64


def address(stage: str = "gnet", key: str = KEY, chunk: int = 0) -> Address:
    return Address("synthetic", "street-seed=1", chunk, stage, key)


class StoreSuite:
    """Contract tests; every value of every kind is small."""

    @pytest.fixture
    def store(self, tmp_path: Path) -> Store:
        raise NotImplementedError

    @pytest.fixture
    def second(self, store: Store) -> Store:
        """The same store, opened once more (as another process would)."""
        raise NotImplementedError

    def commit(self, store: Store, kind: str, at: Address | None = None, seed: int = 0, **fields: Any) -> Any:
        return store.commit(at or address(), kind, make(kind, seed), Provenance(**fields))

    @pytest.mark.parametrize("kind", MAKERS)
    def test_what_is_committed_is_read_back(self, store: Store, second: Store, kind: str) -> None:
        self.commit(store, kind)
        found = second.find(address())
        assert found is not None and found.manifest.kind == kind
        assert_same(make(kind), second.read(found), kind, COLORS)

    @pytest.mark.parametrize("kind", MAKERS)
    def test_the_same_value_has_the_same_payload(self, store: Store, kind: str) -> None:
        one = self.commit(store, kind, address(key=KEY), seconds=1.0, created_at="2001-01-01")
        two = self.commit(store, kind, address(key=OTHER), seconds=2.0, environment={"host": "x"})
        other = self.commit(store, kind, address(key="c" * 64), seed=1)
        assert one.manifest.files == two.manifest.files
        assert one.manifest.payload_digest == two.manifest.payload_digest != other.manifest.payload_digest

    @pytest.mark.parametrize("kind", ["novel_views", "fixed_views"])
    def test_what_was_read_is_committed_as_the_same_bytes(self, store: Store, kind: str) -> None:
        one = self.commit(store, kind)
        again = store.read(store.commit(address(key=OTHER), kind, store.read(one)))
        assert_same(store.read(one), again, kind, COLORS)

    def test_absent_is_none(self, store: Store) -> None:
        assert store.find(address()) is None
        assert list(store.artifacts()) == []

    def test_manifest_says_what_was_given(self, store: Store) -> None:
        fields = {
            "inputs": {"initial": OTHER},
            "configuration": {"iterations": 3, "loss": {"rgb": 0.8}},
            "code_digest": "c" * 64,
            "weights_digest": "d" * 64,
            "seconds": 1.5,
            "peak_mib": 12.25,
            "environment": {"python": "3"},
            "measurements": {"marks": ["one"], "bad": float("nan")},
            "warnings": ("careful",),
        }
        made = self.commit(store, "reconstruction", **fields)
        found = store.find(address())
        assert found is not None
        for name, value in fields.items():
            if name != "measurements":
                assert getattr(found.manifest, name) == value
        assert found.manifest.measurements["marks"] == ["one"] and found.manifest.measurements["bad"] is None
        assert found.manifest.measurements["culled"] == {"behind": 3, "non_finite": 0}
        assert found.manifest == made.manifest and found.manifest.created_at.startswith("20")

    def test_first_writer_wins(self, store: Store, second: Store) -> None:
        one = self.commit(store, "evaluation", seed=0, seconds=1.0)
        two = self.commit(second, "evaluation", seed=1, seconds=2.0)
        assert two.manifest == one.manifest
        assert_same(make("evaluation", 0), store.read(two), "evaluation")

    @pytest.mark.parametrize("kind", ["reconstruction", "novel_views"])
    def test_many_threads_on_one_key(self, store: Store, second: Store, kind: str) -> None:
        results: list[Any] = []
        start = threading.Barrier(6)

        def work(k: int) -> None:
            start.wait()
            results.append(self.commit((store, second)[k % 2], kind, seed=k, warnings=(str(k),)))

        threads = [threading.Thread(target=work, args=(k,)) for k in range(6)]
        for t in threads:
            t.start()
        for t in threads:
            t.join()
        assert len(results) == 6 and len({r.manifest.warnings for r in results}) == 1
        winner = int(results[0].manifest.warnings[0])
        assert_same(make(kind, winner), store.read(results[0]), kind, COLORS)
        assert len(list(store.artifacts())) == 1

    def test_discard_removes_that_one_only(self, store: Store) -> None:
        one, two = self.commit(store, "evaluation"), self.commit(store, "evaluation", address(key=OTHER))
        store.discard(one)
        assert store.find(address()) is None
        assert [a.address for a in store.artifacts()] == [two.address]
        store.discard(one)
        store.discard(two.address)
        assert list(store.artifacts()) == []
        assert self.commit(store, "evaluation").address == one.address

    def test_an_artifact_that_was_replaced_is_not_discarded(self, store: Store) -> None:
        old = self.commit(store, "evaluation", warnings=("old",))
        store.discard(old)
        new = self.commit(store, "evaluation", warnings=("new",))
        store.discard(old)
        found = store.find(address())
        assert found is not None and found.manifest == new.manifest
        store.verify(found)

    def test_artifacts_filters(self, store: Store) -> None:
        places = [
            ("evaluate/gnet", KEY, 0),
            ("gnet", KEY, 0),
            ("gnet", OTHER, 0),
            ("gnet", KEY, 1),
            ("initial", KEY, 0),
        ]
        wanted = [address(*place) for place in places]
        for at in wanted:
            self.commit(store, "evaluation", at)
        assert sorted(a.address for a in store.artifacts()) == sorted(wanted)
        assert {a.address for a in store.artifacts(stage="gnet")} == {a for a in wanted if a.stage == "gnet"}
        assert [a.address for a in store.artifacts(chunk=1)] == [wanted[3]]
        assert [a.address for a in store.artifacts("synthetic", "street-seed=1", 0, "evaluate/gnet")] == [wanted[0]]
        assert [a.address for a in store.artifacts(key=OTHER)] == [wanted[2]]
        assert list(store.artifacts(dataset="pandaset")) == [] == list(store.artifacts(kind="chunk"))

    def test_unknown_kind_says_what_is_known(self, store: Store) -> None:
        with pytest.raises(ConfigError, match=r"Did you mean 'chunk'.*evaluation"):
            store.commit(address(), "chunks", None)

    def test_a_value_that_does_not_encode_leaves_nothing(self, store: Store) -> None:
        bad = make("novel_views")
        bad.depth[1, 2, 3] = float("nan")
        with pytest.raises(NonFiniteError, match=r"render depth holds 1 .*\(1, 2, 3\)"):
            store.commit(address(), "novel_views", bad)
        assert store.find(address()) is None

    def test_corrupt_is_found_and_recommitted(self, store: Store) -> None:
        one = self.commit(store, "evaluation")
        self.damage(one, "metrics.parquet")
        with pytest.raises(ArtifactCorruptError, match=r"metrics\.parquet"):
            store.verify(one)
        two = self.commit(store, "evaluation", warnings=("anew",))
        store.verify(two)
        assert two.manifest.warnings == ("anew",)

    def damage(self, artifact: Any, name: str) -> None:
        """Flip one bit of a file; a store that is no folder overrides this."""
        path = artifact.path / name
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 4
        path.write_bytes(data)

    def test_names_of_no_folder_are_refused(self) -> None:
        for dataset, log, stage, key in (
            ("..", "l", "s", "k"),
            ("d", "a/b", "s", "k"),
            ("d", "l", "s//t", "k"),
            ("d", "l", "../s", "k"),
            ("d", "l", "s", ""),
            ("d", "l", "s", ".hidden"),
            ("d", "l\n", "s", "k"),
        ):
            with pytest.raises(ConfigError, match="cannot be a folder's name"):
                Address(dataset, log, 0, stage, key)
        with pytest.raises(ConfigError, match="negative"):
            Address("d", "l", -1, "s", "k")
        assert MANIFEST not in str(address())

    def test_two_never_compute_one_artifact_at_once(self, store: Store, second: Store) -> None:
        running: list[str] = []
        most = []
        start = threading.Barrier(4)

        def work(k: int) -> None:
            start.wait()
            with (store, second)[k % 2].lease(address()):
                running.append("x")
                most.append(len(running))
                time.sleep(0.05)
                running.pop()

        threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
        for t in threads:
            t.start()
        for t in threads:
            t.join()
        assert most == [1, 1, 1, 1]

    def test_a_lease_ends_with_an_error_and_is_of_one_artifact(self, store: Store, second: Store) -> None:
        with pytest.raises(KeyError), store.lease(address()):
            raise KeyError
        with second.lease(address()), store.lease(address(key=OTHER)):
            pass

    def test_records_are_seen_by_others(self, store: Store, second: Store) -> None:
        for name in ("aa", "ab"):
            folder = store.records.pull(f"runs/{name}")
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "run.json").write_text(name)
            store.records.push(f"runs/{name}")
        assert (second.records.pull("runs/ab") / "run.json").read_text() == "ab"
        assert [path.read_text() for path in second.records.find("runs", "run.json")] == ["aa", "ab"]
        assert [path.parent.name for path in second.records.find("runs", "run.json", "ab")] == ["ab"]
        # Somebody may give a path in the place of a name.
        assert second.records.find("runs", "run.json", "/data/runs/ab") == []
        assert second.records.find("runs", "run.json", "ab/x") == []
        store.records.remove("runs/aa")
        store.records.remove("runs/none")
        assert [path.read_text() for path in second.records.find("runs", "run.json")] == ["ab"]
        assert list(store.artifacts()) == []

    @pytest.mark.parametrize("name", ["../out", "runs/..", "/runs", "runs//a", "runs/.hidden", ""])
    def test_records_stay_in_the_store(self, store: Store, name: str) -> None:
        with pytest.raises(ConfigError, match="record's folder"):
            store.records.pull(name)

    def test_a_store_exists_once_something_was_written(self, store: Store) -> None:
        assert not store.exists()
        store.check_writable()
        self.commit(store, "evaluation")
        assert store.exists()
        assert [damage for _, damage in store.verify_all()] == [None]

    def test_single_files_are_fetched(self, store: Store, second: Store) -> None:
        self.commit(store, "evaluation")
        found = second.find(address())
        assert found is not None
        assert (second.fetch(found, ".parquet") / "metrics.parquet").is_file()
        assert second.fetch(found) == found.path

    @pytest.mark.parametrize("kind", ["evaluation", "novel_views"])
    def test_an_artifact_of_another_store_is_adopted_as_it_is(self, store: Store, tmp_path: Path, kind: str) -> None:
        other = LocalStore(tmp_path / "other")
        given = self.commit(other, kind, warnings=("careful",))
        adopted = store.adopt(given.manifest, other.fetch(given))
        assert adopted.manifest == given.manifest
        store.verify(adopted)
        assert_same(make(kind), store.read(adopted), kind, COLORS)
        # The first one stays.
        self.commit(other, kind, address(key=OTHER), seed=1)
        assert store.adopt(given.manifest, other.fetch(given)).manifest == given.manifest
        assert len(list(store.artifacts())) == 1

    def test_a_damaged_artifact_is_not_adopted(self, store: Store, tmp_path: Path) -> None:
        other = LocalStore(tmp_path / "other")
        given = self.commit(other, "evaluation")
        (given.path / "metrics.parquet").write_bytes(b"else")
        with pytest.raises(ArtifactCorruptError, match=r"metrics\.parquet"):
            store.adopt(given.manifest, given.path)
        assert store.find(address()) is None
