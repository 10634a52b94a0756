"""Storage classes of the package, made known to this process.

A repository carries its own copy (``configs/butler.yaml``); pipelines that are built without one need them here.
"""

from __future__ import annotations

import functools

from lsst.daf.butler import Config, StorageClassConfig, StorageClassFactory

STORAGE_CLASSES = "resource://lsst.fringe_sim/configs/storageClasses.yaml"
"""Where the storage classes are defined."""


@functools.cache
def register_storage_classes() -> tuple[str, ...]:
    """Add the storage classes of the package to the factory of this process.

    Returns
    -------
    names : `tuple` [`str`, ...]
        Their names.
    """
    definitions = Config(STORAGE_CLASSES)
    config = StorageClassConfig({"storageClasses": definitions.toDict()}, mergeDefaults=False, validate=False)
    StorageClassFactory().addFromConfig(config)
    return tuple(sorted(definitions))
