"""The house keeps its rules: imports go one way, the code is linted and typed, the files users rely on are sound."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent


def _assert_runs(*command: str) -> None:
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]


def test_imports_go_one_way() -> None:
    _assert_runs(str(Path(sys.executable).parent / "lint-imports"))


def test_ruff_finds_nothing() -> None:
    _assert_runs(sys.executable, "-m", "ruff", "check", ".")


def test_code_is_formatted() -> None:
    _assert_runs(sys.executable, "-m", "ruff", "format", "--check", ".")


def test_types_hold() -> None:
    _assert_runs(sys.executable, "-m", "mypy")


def test_compose_file_follows_the_specification() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((ROOT / "tests/data/compose_spec.json").read_text())
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
    jsonschema.Draft201909Validator(schema).validate(compose)
    services = compose["services"]
    once = {name for name, service in services.items() if service.get("restart") == "no"}
    assert once == {"setup", "bucket"}
    assert set(services) - once == {"database", "server", "objects", "coordinator", "worker", "gpu-worker"}
    for name, service in services.items():
        assert name in once or "healthcheck" in service, name
        for needed, how in service.get("depends_on", {}).items():
            finished = how["condition"] == "service_completed_successfully"
            assert finished == (needed in once)
    named = {
        v.split(":")[0] for s in compose["services"].values() for v in s.get("volumes", []) if "/" not in v[:1] + v[:2]
    }
    assert {n for n in named if re.fullmatch(r"\w+", n)} == set(compose["volumes"])


def test_the_image_has_what_flows_read_beside_them() -> None:
    worker = (ROOT / "Dockerfile").read_text().rpartition("FROM ")[2]
    assert {"COPY flows /app/flows", "COPY configs /app/configs", "WORKDIR /app"} <= set(worker.splitlines())


def test_deployments_name_flows_that_exist() -> None:
    for deployment in yaml.safe_load((ROOT / "prefect.yaml").read_text())["deployments"]:
        path, _, function = deployment["entrypoint"].partition(":")
        assert f"def {function}(" in (ROOT / path).read_text()


def test_every_required_package_is_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {
        re.sub(r"[-_.]+", "-", line.split("==")[0]).lower()
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    }
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["dev"]]
    # The tests' own extra names others of this project: their packages are installed with it.
    for own in [w for w in wanted if w.startswith("genre[")]:
        wanted.remove(own)
        wanted += [w for name in re.split(r"[\[\],]", own)[1:-1] for w in extras[name]]
    names = {re.sub(r"[-_.]+", "-", re.split(r"[<>=\[ ]", w)[0]).lower() for w in wanted}
    assert names <= pinned, sorted(names - pinned)


def test_help_does_not_load_the_heavy_packages() -> None:
    code = (
        "import sys\n"
        "import flows.cli.main\n"
        "heavy = {'torch', 'prefect', 'kornia', 'diffusers', 'pyarrow', 'numpy'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(heavy)) or 0)"
    )
    _assert_runs(sys.executable, "-c", code)
