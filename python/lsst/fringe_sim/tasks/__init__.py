"""PipelineTasks, one per file: they fetch, call one algorithm, and store what it returns.

Each is imported on first use. Importing this package makes the storage classes known that their connections name.
"""

from __future__ import annotations

from ..lazy import homes, on_first_use
from ..middleware import register_storage_classes

register_storage_classes()

_LAZY = homes(
    effect_discovery="EffectDiscoveryConfig EffectDiscoveryTask SkyEffectDiscoveryConfig SkyEffectDiscoveryTask",
    epoxy_fit="EpoxyFitConfig EpoxyFitTask",
    focal_plane_summary="FocalPlaneSummaryConfig FocalPlaneSummaryTask",
    fringe_bias="FringeBiasConfig FringeBiasTask",
    fringe_correction="FringeCorrectionConfig FringeCorrectionTask",
    fringe_forecast="FringeForecastConfig FringeForecastTask",
    fringe_pca="FringePcaConfig FringePcaTask",
    isr_flat_prep="IsrFlatPrepConfig IsrFlatPrepTask",
    map_templates="MapTemplatesConfig MapTemplatesTask",
    model_config="FringeModelConfig RaftConfig SensorConfig",
    observed_fringe="ObservedFringeConfig ObservedFringeTask",
    quantum="UnusableDataError",
    sky_fringe_sim="SkyFringeSimConfig SkyFringeSimTask",
)

__all__ = sorted(_LAZY)  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__ = on_first_use(__name__, _LAZY)
