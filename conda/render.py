# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Render the recipe with rattler-build for each version of Python, without building and without the network."""

from __future__ import annotations

from pathlib import Path

from rattler_build import RenderConfig, Stage0Recipe, VariantConfig




def render() -> list[dict[str, object]]:
    """The recipe as it would be built, once for each version of Python."""
    folder = Path(__file__).parent
    recipe = Stage0Recipe.from_file(folder / "recipe.yaml")
    variants = recipe.render(VariantConfig.from_file(folder / "variants.yaml"), RenderConfig())
    return [variant.recipe.to_dict() for variant in variants]


if __name__ == "__main__":
    for rendered in render():
        print(rendered)
