"""Configuration of the stages: bounded pydantic models. A stage gets its own section and nothing else.

Defaults are the paper's numbers where the paper gives one (Sec. III and IV); presets in ``configs/`` say what they
change and why.
"""

from __future__ import annotations

from pydantic import Field

from genre_tasks.config.effect_settings import EffectsConfig, EffectSetting, ReportOnlySetting
from genre_tasks.config.limits import LimitsConfig
from genre_tasks.config.optimisation_sections import (
    AdamConfig,
    DensityConfig,
    GnetConfig,
    LossConfig,
    OptimiserConfig,
    PerSceneConfig,
    RefineConfig,
)
from genre_tasks.config.section import FilePlacement, LearningRate, LearningRates, LearningRateTuple, Section
from genre_tasks.config.simulation_sections import KinematicBounds, SimulateConfig
from genre_tasks.config.stage_sections import (
    LPIPS_NETWORKS,
    EvaluateConfig,
    FnetConfig,
    IngestConfig,
    InitialConfig,
    NovelViewsConfig,
    RangeConfig,
)

__all__ = [
    "LPIPS_NETWORKS",
    "AdamConfig",
    "DensityConfig",
    "EffectSetting",
    "EffectsConfig",
    "EvaluateConfig",
    "FilePlacement",
    "FnetConfig",
    "GnetConfig",
    "IngestConfig",
    "InitialConfig",
    "KinematicBounds",
    "LearningRate",
    "LearningRateTuple",
    "LearningRates",
    "LimitsConfig",
    "LossConfig",
    "NovelViewsConfig",
    "OptimiserConfig",
    "PerSceneConfig",
    "PipelineConfig",
    "RangeConfig",
    "RefineConfig",
    "ReportOnlySetting",
    "Section",
    "SimulateConfig",
]


# Order matters: it is the order of the stages, of the printed configuration and of its reference.
class PipelineConfig(Section):
    """The complete configuration: one section for each stage, and one for simulations of a finished run.

    >>> PipelineConfig().gnet.iterations
    24
    """

    ingest: IngestConfig = Field(IngestConfig(), description="Reading the log: chunks, views and resolution.")
    initial: InitialConfig = Field(InitialConfig(), description="The Gaussians that optimisation starts from.")
    gnet: GnetConfig = Field(GnetConfig(), description="Reconstruction from source views.")
    novel_views: NovelViewsConfig = Field(NovelViewsConfig(), description="Rendering views beside the path.")
    fnet: FnetConfig = Field(FnetConfig(), description="Repairing these renders.")
    # The paper's ENet has half of GNet's iterations, and learns from fixed novel views, too.
    enet: OptimiserConfig = Field(
        OptimiserConfig(iterations=12, novel_views_per_iteration=6),
        description="Enhancing the scene with the repaired views.",
    )
    evaluate: EvaluateConfig = Field(EvaluateConfig(), description="What is measured after a stage.")
    effects: EffectsConfig = Field(EffectsConfig(), description="Parts of the forward model that a scene gets.")
    simulate: SimulateConfig = Field(SimulateConfig(), description="Re-simulation of a finished run.")
    limits: LimitsConfig = Field(LimitsConfig(), description="What a run may take of the machine.")
