"""Pictures of the documentation, docs/images: `python -m experiments.documentation.pictures`, or some by their names."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torchmbd as mbd
from experiments.documentation.animated_svg import animated_svg, drawing

IMAGES = Path(__file__).parents[2] / "docs" / "images"
SCALE = 10.0  # of the rod's deflections


def slider_crank(folder: Path) -> Path:
    """The rod of the slider-crank before and after the optimization of its three ply angles, deflections enlarged."""
    from torchmbd.examples.slider_crank import build

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
    result = mbd.optimize(problem, "mmfd")
    designs = {
        "rod.laminate.angles": torch.stack([mbd.deg([45, -45, 45]), torch.as_tensor(result.x, dtype=torch.float64)])
    }
    motion = mbd.simulate(system, 0.0504, steps=504, designs=designs, gradients="none").require_ok()
    angles = "/".join(f"{x:.0f}" for x in torch.rad2deg(torch.as_tensor(result.x, dtype=torch.float64)).round().abs())
    stored = [float(x) for x in mbd.Integral(energy)(motion)]
    texts = (
        f"plies at 45/-45/45 degrees: {1e3 * stored[0]:.2f} mJ s",
        f"optimized, {angles} degrees: {1e3 * stored[1]:.2f} mJ s",
    )
    columns = [(text, drawing(motion, 61, scale=SCALE, lane=k)) for k, text in enumerate(texts)]
    return animated_svg(columns, folder / "slider_crank.svg", duration=0.0504, scale=SCALE)


def robot_arm(folder: Path) -> Path:
    """The arm of the tutorial from above, both plies at 45 degrees and as the tutorial's study leaves them."""
    from experiments.tutorial.arm import build

    designs = {"arm.section.angles": torch.stack([mbd.deg([45.0, -45.0]), mbd.deg([-14.34, 0.73])])}
    motion = mbd.simulate(build(), 0.7, steps=175, designs=designs, gradients="none").require_ok()
    texts = ("plies at 45/-45 degrees", "optimized, -14/1 degrees")
    columns = [(text, drawing(motion, 57, scale=3.0, lane=k)) for k, text in enumerate(texts)]
    return animated_svg(columns, folder / "robot_arm.svg", duration=0.7, scale=3.0)


def two_link_arm(folder: Path) -> Path:
    """The two-link arm whose elbow latches."""
    from torchmbd.examples.two_link_arm import build, phases

    motion = mbd.simulate(build(), 1.2, steps=400, phases=phases(), gradients="none", spectral_radius=0.7).require_ok()
    tip = {"fore": [(-0.15, 0, 0), (0.15, 0, 0)]}
    return animated_svg([("", drawing(motion, 61, along=tip))], folder / "two_link_arm.svg", duration=1.2)


def spatial_arm(folder: Path) -> Path:
    """The spatial arm of two tubes from rest, deflections enlarged."""
    from experiments.models.spatial_arm import END, build

    motion = mbd.simulate(build(), END, steps=300, gradients="none", start="equilibrium").require_ok()
    lines = drawing(motion, 61, view="iso", scale=10.0)
    return animated_svg([("", lines)], folder / "spatial_arm.svg", duration=END, scale=10.0)


def antenna(folder: Path) -> Path:
    """The first phase of the antenna from the side."""
    from experiments.models.sar_antenna import build

    motion = mbd.simulate(build((55.0, -55.0), modes=4), 7.9, steps=1580, gradients="none")
    return animated_svg([("", drawing(motion, 61, view="xz"))], folder / "antenna.svg", 6.0, duration=7.9)


def _of_gallery(name: str, **how: Any) -> Callable[[Path], Path]:
    def picture(folder: Path) -> Path:
        seconds = how.pop("seconds", 4.0)
        motion = importlib.import_module(f"experiments.models.{name}").motion().require_ok()
        lines = drawing(motion, **how)
        return animated_svg(
            [("", lines)], folder / f"{name}.svg", seconds, float(motion.t[-1]), float(how.get("scale", 1.0))
        )

    return picture


PICTURES: dict[str, Callable[[Path], Path]] = {
    "slider_crank": slider_crank,
    "robot_arm": robot_arm,
    "two_link_arm": two_link_arm,
    "spatial_arm": spatial_arm,
    "antenna": antenna,
    "four_bar": _of_gallery("four_bar", scale=20.0),
    "chain": _of_gallery("chain", frames=81),
    "spacecraft": _of_gallery("spacecraft", view="iso"),
    "delta_robot": _of_gallery("delta_robot", frames=41, scale=50.0, view="iso"),
    "falling_arm": _of_gallery("falling_arm", frames=101, along={"fore": [(0, 0, 0), (0.5, 0, 0)]}),
    "flapping_blade": _of_gallery("flapping_blade", scale=3.0, view="xz"),
}


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
