"""The stages as plain functions, without Prefect and without a store: what a notebook would do.

python docs/examples/plain_functions.py
"""

from __future__ import annotations

from flows.configuration import load_configuration
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.results import Evaluation
from genre_tasks.stages.effects import effects
from genre_tasks.stages.enet import enet
from genre_tasks.stages.evaluate import evaluate_scene
from genre_tasks.stages.fnet import fnet
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from genre_tasks.stages.novel_views import novel_views


def reconstruct(uri: str, settings: list[str]) -> dict[str, Evaluation]:
    """One chunk of a log through the chain; the evaluation after each reconstructing stage."""
    config = load_configuration("demo", settings=settings)
    log = open_log(uri)
    chunk = ingest(config.ingest, log, 0)
    plan = effects(config.effects, chunk, log)
    scenes = {"initial": initial(config.initial, chunk, plan)}
    scenes["gnet"] = gnet(config.gnet, chunk, scenes["initial"], plan)
    fixed = fnet(config.fnet, chunk, novel_views(config.novel_views, chunk, scenes["gnet"], plan), plan)
    scenes["enet"] = enet(config.enet, chunk, scenes["gnet"], fixed, plan)
    return {
        name: evaluate_scene(config.evaluate, chunk, name, scene, log.truth, plan) for name, scene in scenes.items()
    }


if __name__ == "__main__":
    for stage, evaluation in reconstruct("synthetic:street?seed=1000", []).items():
        for metric in evaluation.metrics:
            print(f"{stage:<8} {metric.name:<26} {metric.value:10.4f}  n = {metric.n}")
