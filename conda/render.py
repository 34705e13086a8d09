# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Render the recipe with rattler-build, without building and without the network, and print what would be built."""

from __future__ import annotations

import json
from pathlib import Path

from rattler_build import RenderConfig, Stage0Recipe, VariantConfig

if __name__ == "__main__":
    folder = Path(__file__).parent
    recipe = Stage0Recipe.from_file(folder / "recipe.yaml")
    for variant in recipe.render(VariantConfig.from_file(folder / "variants.yaml"), RenderConfig()):
        print(json.dumps(variant.recipe.to_dict(), indent=2))
