"""Pictures of the documentation, docs/images: `python -m experiments.documentation.pictures`, or some by their names."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import torch

import torchmbd as mbd
from experiments.documentation.animated_svg import animated_svg, drawing

IMAGES = Path(__file__).parents[2] / "docs" / "images"
SCALE = 10.0  # of the rod's deflections


def slider_crank(folder: Path) -> Path:
    """The rod of the slider-crank before and after the optimization of its three ply angles, deflections enlarged."""
    from experiments.slider_crank import build

    system = build(layers=3, cells=(16, 2))
    energy = mbd.StrainEnergy("rod")
    problem = mbd.Problem(
        system,
        duration=0.06,
        steps=600,
        minimize=mbd.Integral(energy),
        subject_to=[mbd.Max(energy) <= "initial"],
        bounds=mbd.deg([-90, 90]),
    )
    result = mbd.optimize(problem)
    designs = {"rod.laminate.angles": torch.stack([mbd.deg([45, -45, 45]), torch.as_tensor(result.x)])}
    motion = mbd.simulate(system, 0.0504, steps=504, designs=designs, gradients="none").require_ok()
    angles = "/".join(f"{x:.0f}" for x in torch.rad2deg(torch.as_tensor(result.x)).round().abs())
    stored = [float(x) for x in mbd.Integral(energy)(motion)]
    texts = (
        f"plies at 45/-45/45 degrees: {1e3 * stored[0]:.2f} mJ s",
        f"optimized, {angles} degrees: {1e3 * stored[1]:.2f} mJ s",
    )
    columns = [(text, drawing(motion, 61, scale=SCALE, lane=k)) for k, text in enumerate(texts)]
    return animated_svg(columns, folder / "slider_crank.svg")


PICTURES: dict[str, Callable[[Path], Path]] = {"slider_crank": slider_crank}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", choices=[[], *PICTURES], help="default: all")
    parser.add_argument("--folder", type=Path, default=IMAGES)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for name in arguments.names or PICTURES:
        file = PICTURES[name](arguments.folder)
        print(f"{file} {file.stat().st_size / 1024:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
