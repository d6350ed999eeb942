"""What a video shows: a run sampled at the video's frames, where everything is, and the strip of figures below."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.report import style
from equimus_ctrl.report.drawing import Skeleton, base_span, first_pass, skeleton
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.scenarios.scoring import on_grid
from equimus_ctrl.types import Array, Run

Frame = NDArray[np.uint8]
TRAIL_TIME = 6.0  # [s] of the path that stays visible
PALE = 0.45


@dataclass(frozen=True, eq=False)
class Film:
    """A run, frame by frame.

    Attributes:
        morphology: the robot.
        phase: base fixed or foot pinned.
        fps: frames a second.
        time: (n,) [s].
        position: (n, nj) joint angles [rad].
        command: (n, na) commands in force [Pa].
        reference: (k, nj) poses wanted over the whole run [rad].
        width: of the frames [pixel].
        height: of the picture without the strip [pixel].
    """

    morphology: Morphology
    phase: Phase
    fps: float
    time: Array
    position: Array
    command: Array
    reference: Array
    width: int
    height: int

    @cached_property
    def bones(self) -> Skeleton:
        """Where links and actuators are in each frame."""
        return skeleton(self.morphology, self.position, self.phase)

    @property
    def traced(self) -> Array:
        """(n, 2) the foot in swing, the base in stance [m]."""
        return self.bones.foot if self.phase == "swing" else self.bones.base

    @cached_property
    def target(self) -> Array:
        """(k, 2) the path the traced point should take [m], NaN in gaps."""
        wanted = skeleton(self.morphology, self.reference, self.phase)
        return first_pass(wanted.foot if self.phase == "swing" else wanted.base)

    @property
    def box(self) -> tuple[Array, Array]:
        """(low, high), each (2,): corners of a box that holds everything in all frames [m]."""
        above = np.array([[x, -0.06 * self.size] for x in base_span(self.morphology)])
        plate = (self.bones.base[:, None] + above).reshape(-1, 2)
        points = np.concatenate([self.bones.points, plate, self.target[np.isfinite(self.target[:, 0])]])
        return points.min(axis=0), points.max(axis=0)

    @property
    def size(self) -> float:
        """Length of all links together [m]."""
        return sum(link.length for link in self.morphology.links)

    @property
    def fill(self) -> Array:
        """(n, na) each command's place in the range, 0 to 1."""
        m = self.morphology
        return np.clip((self.command - m.command_low) / (m.command_high - m.command_low), 0.0, 1.0)

    @property
    def trail_frames(self) -> int:
        """How many frames of the path stay visible."""
        return round(TRAIL_TIME * self.fps)

    def colour(self, actuator: int, fill: float) -> tuple[float, float, float]:
        """Of an actuator: pale when empty, full when at the highest pressure."""
        full = np.array(to_rgb(style.actuator_colour(actuator)))
        red, green, blue = 1.0 - (PALE + (1.0 - PALE) * fill) * (1.0 - full)
        return float(red), float(green), float(blue)


def make_film(run: Run, model: Model, fps: float, width: int, height: int) -> Film:
    """Sample a run at the frames of a video that lasts as long as the run.

    Args:
        run: what happened.
        model: whose morphology and phase are shown.
        fps: frames a second.
        width: of the frames [pixel].
        height: of the picture without the strip [pixel].

    Raises:
        ConfigError: where the run is not of the model's robot.
    """
    m = model.morphology
    if (run.spec.joints, run.spec.actuators) != (m.joint_names, m.actuator_names):
        raise ConfigError(
            f"the run has joints {', '.join(run.spec.joints)} and actuators {', '.join(run.spec.actuators)}, but "
            f"{m.name} has {', '.join(m.joint_names)} and {', '.join(m.actuator_names)}"
        )
    n = max(round((run.time[-1] - run.time[0] + run.spec.control_dt) * fps), 1)
    time = run.time[0] + np.arange(n) / fps
    rows = np.clip(np.searchsorted(run.time, time + 1e-9, side="right") - 1, 0, len(run.time) - 1)
    position = on_grid(run.time, run.position, time)
    return Film(m, model.phase, fps, time, position, run.command[rows], run.reference, width, height)


def palette_colours(film: Film) -> list[tuple[int, int, int]]:
    """Colours that any frame may hold, for a palette that serves all of them."""
    ramps = [film.colour(i, fill) for i in range(len(film.morphology.actuators)) for fill in (0.0, 0.3, 0.6, 1.0)]
    plain = [to_rgb(style.actuator_colour(i)) for i in range(len(film.morphology.actuators))]
    shades = [tuple(light * part for part in ramp) for ramp in ramps for light in (1.0, 0.8, 0.6)]
    foot = np.array(to_rgb(style.FOOT))
    shades += [tuple(1.0 - fade * (1.0 - foot)) for fade in (0.2, 0.4, 0.6, 0.8, 1.0)]
    fixed = [to_rgb(colour) for colour in (style.INK, style.SHADE, style.GRID, "white")]
    return [tuple(round(255 * part) for part in colour) for colour in (*shades, *plain, *fixed)]  # type: ignore[misc]


class Strip:
    """Draws the strip below the picture: the time and a bar for each commanded pressure."""

    def __init__(self, film: Film) -> None:
        self.film = film
        self.scale = film.width / 720
        self.height = 2 * round(38 * self.scale)
        fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
        self.font = ImageFont.truetype(str(fonts / "DejaVuSans.ttf"), max(round(17 * self.scale), 10))

    def under(self, picture: Frame, k: int) -> Frame:
        """Frame ``k``: the picture with the strip below it."""
        film, s = self.film, self.scale
        image = Image.new("RGB", (film.width, film.height + self.height), "white")
        image.paste(Image.fromarray(picture), (0, 0))
        draw = ImageDraw.Draw(image)
        top = film.height
        draw.line([(0, top), (film.width, top)], fill=style.GRID, width=max(round(2 * s), 1))
        draw.text((16 * s, top + 27 * s), f"{film.time[k] - film.time[0]:.1f} s", fill=style.INK, font=self.font)
        left = 105 * s
        each = (film.width - left - 16 * s) / len(film.morphology.actuators)
        for i, name in enumerate(film.morphology.actuator_names):
            x, wide = left + i * each, each - 16 * s
            label = f"{name} {film.command[k, i] / 1e3:.1f} kPa"
            while self.font.getlength(label) > wide and " " in label:
                label = label.rpartition(" ")[0]
            draw.text((x, top + 12 * s), label, fill=style.INK, font=self.font)
            bar = [x, top + 44 * s, x + wide, top + 58 * s]
            draw.rectangle(bar, fill=style.SHADE)
            if film.fill[k, i] > 0.005:
                bar[2] = x + film.fill[k, i] * wide
                draw.rectangle(bar, fill=style.actuator_colour(i))
        return np.asarray(image)
