"""Films of motions for slides and papers: GIF, or MP4 where ffmpeg is installed.

They show the scene of animation.py, with the same exaggeration of the deformation, seen along one axis.
Drawn by matplotlib, without a display. Checked in tests/viz/test_film.py.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.viz.animation import require_lane, require_motion, scene_of

_ACROSS = {"x": (1, 2), "y": (0, 2), "z": (0, 1)}  # axes of the picture, by the axis along which one looks
_WRITERS = {".gif": "pillow", ".mp4": "ffmpeg"}


def film(
    motion: Any,
    path: str | Path,
    lane: int = 0,
    scale: float | None = None,
    view: str | None = None,
    seconds: float = 6.0,
    frames_per_second: int = 15,
) -> Path:
    """Write the motion of one lane as a film and return its path.

    scale    exaggeration of the deformation; None: the largest is drawn as 5 % of the picture
    view     axis along which one looks, "x", "y" or "z"; None: the shortest side of the visited space
    seconds  how long the film lasts, however long the motion [s]

    Frames are equally spaced in time; each shows the nearest time of the motion.

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> mbd.viz.film(motion, "arm.gif", seconds=0.2, frames_per_second=10).name
    'arm.gif'
    """
    from matplotlib.animation import FuncAnimation, writers
    from matplotlib.figure import Figure

    path = Path(path)
    if path.suffix not in _WRITERS:
        raise InputError("path", str(path), f"a name that ends in {' or '.join(_WRITERS)}")
    if not writers.is_available(_WRITERS[path.suffix]):
        raise InputError(
            "path",
            str(path),
            ".gif",
            shown=repr(str(path)),
            state=f"needs {_WRITERS[path.suffix]}, which is not installed",
        )
    require_motion(motion)
    require_lane(motion, lane)
    count = round(seconds * frames_per_second)
    if count < 2 or frames_per_second < 1:
        raise InputError(
            "seconds",
            seconds,
            "must give at least two frames",
            shown=str(seconds),
            state=f"at {frames_per_second} frames per second gives {count}",
        )
    t = motion.t.detach().numpy()
    frames = np.interp(np.linspace(t[0], t[-1], count), t, np.arange(len(t))).round().astype(int)  # nearest times
    scene = scene_of(motion, lane, frames)
    axis = view or scene["view"]
    if axis not in _ACROSS:
        raise InputError("view", view, _ACROSS)
    shown = scene["scale"] if scale is None else float(scale)
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    drawing = _Drawing(figure, scene, shown, list(_ACROSS[axis]))
    movie = FuncAnimation(figure, drawing.frame, frames=len(drawing.t), interval=1000.0 / frames_per_second, blit=False)
    movie.save(path, writer=writers[_WRITERS[path.suffix]](fps=frames_per_second), dpi=100)
    return path


def positions(body: dict[str, Any], frames: int, scale: float) -> np.ndarray:
    """Return the points of a body of a scene in ground axes [frames, n, 3].

    These are deformed nodes, or the joints of a rigid body; with the center of mass if there is only one joint.
    """
    r, A = _array(body["r"], frames, 1, 3), _array(body["A"], frames, 3, 3)
    if "weights" not in body:
        points = body["points"]
        local = np.array(points if len(points) > 1 else [*points, body["center"]])[None]
    else:
        weights = _array(body["weights"], frames, -1)
        full, relative = (_array(body[key], weights.shape[1], -1, 3) for key in ("modes", "relative"))
        local = _array(body["x"], -1, 3) + np.einsum("tk,knc->tnc", weights, full + (scale - 1.0) * relative)
    return r + np.einsum("tij,tnj->tni", A, np.broadcast_to(local, (frames, *local.shape[1:])))


class _Drawing:
    """One matplotlib collection for each body of a scene, moved from frame to frame."""

    def __init__(self, figure: Any, scene: dict[str, Any], scale: float, across: list[int]) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        self.t = _array(scene["t"], -1)
        axes = figure.subplots()
        self.bodies = [positions(body, len(self.t), scale)[..., across] for body in scene["bodies"]]
        self.parts = []
        for body in scene["bodies"]:
            corners = np.array(body.get("triangles", []), dtype=int).reshape(-1, 3)
            ends = np.array(body.get("lines", []), dtype=int).reshape(-1, 2)
            plates = PolyCollection([], facecolor="#2a788e", edgecolor="#1f5a6a", linewidth=1.2)
            beams = LineCollection([], color="#2a788e", linewidth=3.0)
            (links,) = axes.plot([], [], color="#667", marker="o", ms=4, lw=3.0 if "points" in body else 0.0)
            axes.add_collection(plates)
            axes.add_collection(beams)
            self.parts.append((corners, ends, plates, beams, links, "points" in body))
        everything = np.concatenate([x.reshape(-1, 2) for x in self.bodies])
        low, high = everything.min(0), everything.max(0)
        margin = 0.08 * float((high - low).max() or 1.0)
        axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
        axes.set(xlabel=f"{'xyz'[across[0]]} [m]", ylabel=f"{'xyz'[across[1]]} [m]")
        axes.spines[["top", "right"]].set_visible(False)
        exaggerated = "" if scale == 1.0 else f", deformation x {scale:g}"
        self.title, self.words = axes.set_title("", loc="left", fontsize=9), exaggerated

    def frame(self, k: int) -> list[Any]:
        for x, (corners, ends, plates, beams, links, rigid) in zip(self.bodies, self.parts, strict=True):
            plates.set_verts(x[k][corners])
            beams.set_segments(list(x[k][ends]))
            if rigid:
                links.set_data(x[k, :, 0], x[k, :, 1])
        self.title.set_text(f"t = {1e3 * self.t[k]:.2f} ms{self.words}")
        return [self.title]


def _array(text: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(shape)
