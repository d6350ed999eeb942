"""What a video shows: a run sampled at the video's frames, where everything is, and the strip below it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.report import style
from equimus_ctrl.report.drawing import Skeleton, base_span, first_pass, skeleton
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.scenarios.scoring import on_grid
from equimus_ctrl.types import Array, PlantSpec, Run

Frame = NDArray[np.uint8]
TRAIL_TIME = 6.0  # [s] of the path that stays visible
PALE = 0.45
LEAST = 1e-9
"""Of the most that came of a command that nothing limits."""


@dataclass(frozen=True, eq=False)
class Film:
    """A run, frame by frame.

    Attributes:
        model: the robot, and whether its base is fixed or its foot pinned.
        spec: names, units and limits.
        fps: frames a second.
        time: (n,) [s].
        position: (n, nj) of the joints [rad or m].
        wanted: (n, nj) where they are wanted then.
        command: (n, na) commands in force.
        reference: (k, nj) poses wanted over the whole run [rad or m].
        width: of the frames [pixel].
        height: of the picture without the strip [pixel].
    """

    model: Model
    spec: PlantSpec
    fps: float
    time: Array
    position: Array
    wanted: Array
    command: Array
    reference: Array
    width: int
    height: int

    @property
    def morphology(self) -> Morphology:
        """The robot where it has elastic actuators."""
        return self.model.morphology

    @property
    def phase(self) -> Phase:
        """Base fixed or foot pinned."""
        return self.model.phase

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

    @cached_property
    def span(self) -> tuple[Array, Array]:
        """(low, high), each (na,): between what commands are shown; what nothing limits by the most that came."""
        most = np.maximum(np.abs(self.command).max(axis=0), LEAST)
        low, high = self.spec.command_low, self.spec.command_high
        return np.where(np.isfinite(low), low, -most), np.where(np.isfinite(high), high, most)

    @property
    def fill(self) -> Array:
        """(n, na) each command's place between these, 0 to 1."""
        low, high = self.span
        return np.clip((self.command - low) / (high - low), 0.0, 1.0)

    @property
    def empty(self) -> Array:
        """(na,) the place of 0, or of what is nearest to it."""
        low, high = self.span
        return np.clip(-low / (high - low), 0.0, 1.0)

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
        model: whose robot and phase are shown.
        fps: frames a second.
        width: of the frames [pixel].
        height: of the picture without the strip [pixel].

    Raises:
        ConfigError: where the run is not of the model's robot.
    """
    m = model.robot
    if (run.spec.joints, run.spec.actuators) != (m.joint_names, m.actuator_names):
        raise ConfigError(
            f"the run has joints {', '.join(run.spec.joints)} and actuators {', '.join(run.spec.actuators)}, but "
            f"{m.name} has {', '.join(m.joint_names)} and {', '.join(m.actuator_names)}"
        )
    n = max(round((run.time[-1] - run.time[0] + run.spec.control_dt) * fps), 1)
    time = run.time[0] + np.arange(n) / fps
    rows = np.clip(np.searchsorted(run.time, time + 1e-9, side="right") - 1, 0, len(run.time) - 1)
    position, wanted = (on_grid(run.time, values, time) for values in (run.position, run.reference))
    return Film(model, run.spec, fps, time, position, wanted, run.command[rows], run.reference, width, height)


def palette_colours(film: Film) -> list[tuple[int, int, int]]:
    """Colours that any frame may hold, for a palette that serves all of them."""
    drives = range(len(film.spec.actuators))
    ramps = [film.colour(i, fill) for i in drives for fill in (0.0, 0.3, 0.6, 1.0)]
    plain = [to_rgb(style.actuator_colour(i)) for i in drives]
    plain += [to_rgb(style.joint_colour(j)) for j in range(len(film.spec.joints))]
    shades = [tuple(light * part for part in ramp) for ramp in ramps for light in (1.0, 0.8, 0.6)]
    foot = np.array(to_rgb(style.FOOT))
    shades += [tuple(1.0 - fade * (1.0 - foot)) for fade in (0.2, 0.4, 0.6, 0.8, 1.0)]
    fixed = [to_rgb(colour) for colour in (style.INK, style.SHADE, style.GRID, "white")]
    return [tuple(round(255 * part) for part in colour) for colour in (*shades, *plain, *fixed)]  # type: ignore[misc]


class Curves:
    """Draws where the joints are and where they are wanted, over the whole run, with a line at the time of a frame.

    Args:
        film: what is shown.

    Attributes:
        height: [pixel].
    """

    def __init__(self, film: Film) -> None:
        self._film = film
        scale = film.width / 720
        self.height = 2 * round(64 * scale)
        dpi = 100 * scale
        figure = Figure(figsize=(film.width / dpi, self.height / dpi), dpi=dpi, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        units = tuple(dict.fromkeys(film.spec.joint_units))
        self._panels = []
        for i, unit in enumerate(units):
            own, wide = reading(unit), 1 / len(units)
            axes = figure.add_axes((i * wide + 0.08, 0.2, wide - 0.09, 0.72))
            for j in (j for j, kind in enumerate(film.spec.joint_units) if kind == unit):
                colour = style.joint_colour(j)
                axes.plot(
                    film.time, own.factor * film.wanted[:, j], color=colour, linewidth=0.8, linestyle=style.DASHES
                )
                axes.plot(film.time, own.factor * film.position[:, j], color=colour, label=film.spec.joints[j])
            axes.set_xlim(film.time[0], max(film.time[-1], film.time[0] + 1 / film.fps))
            axes.margins(y=0.1)
            axes.tick_params(labelsize=7, length=2, pad=1)
            axes.set_ylabel(own.unit, fontsize=7, labelpad=1)
            axes.legend(fontsize=6, loc="upper right", ncols=3, frameon=False, borderpad=0.0)
            axes.spines[["top", "right"]].set_visible(False)
            self._panels.append(axes)
        canvas.draw()  # type: ignore[no-untyped-call]
        self._drawn = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())  # type: ignore[no-untyped-call]

    def at(self, k: int) -> Image.Image:
        """The curves with a line at the time of frame ``k``."""
        image = self._drawn.copy()
        draw = ImageDraw.Draw(image)
        for axes in self._panels:
            box = axes.get_window_extent()
            x = float(axes.transData.transform((self._film.time[k], 0.0))[0])
            draw.line([(x, self.height - box.y1), (x, self.height - box.y0)], fill=style.INK)
        return image


class Strip:
    """Draws the strip below the picture: curves of the joints, the time, and a bar for each command."""

    def __init__(self, film: Film) -> None:
        self.film = film
        self.scale = film.width / 720
        self._bars = 2 * round(38 * self.scale)
        self._curves = Curves(film)
        self.height = self._bars + self._curves.height
        fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
        self.font = ImageFont.truetype(str(fonts / "DejaVuSans.ttf"), max(round(17 * self.scale), 10))

    def under(self, picture: Frame, k: int) -> Frame:
        """Frame ``k``: the picture with the strip below it."""
        film, s = self.film, self.scale
        image = Image.new("RGB", (film.width, film.height + self.height), "white")
        image.paste(Image.fromarray(picture), (0, 0))
        image.paste(self._curves.at(k), (0, film.height))
        draw = ImageDraw.Draw(image)
        top = film.height + self._curves.height
        draw.line([(0, top), (film.width, top)], fill=style.GRID, width=max(round(2 * s), 1))
        draw.text((16 * s, top + 27 * s), f"{film.time[k] - film.time[0]:.1f} s", fill=style.INK, font=self.font)
        left = 105 * s
        each = (film.width - left - 16 * s) / len(film.spec.actuators)
        for i, name in enumerate(film.spec.actuators):
            x, wide = left + i * each, each - 16 * min(s, each / 40)
            own = reading(film.spec.command_units[i])
            number = round(float(film.command[k, i]) * own.factor, 1) + 0.0  # no -0.0
            label = f"{name} {number:.1f}{own.space if own.unit else ''}{own.unit}"
            while self.font.getlength(label) > wide and " " in label:
                label = label.rpartition(" ")[0]
            while self.font.getlength(label) > wide and label:
                label = label[:-1]
            draw.text((x, top + 12 * s), label, fill=style.INK, font=self.font)
            bar = [x, top + 44 * s, x + wide, top + 58 * s]
            draw.rectangle(bar, fill=style.SHADE)
            low, high = sorted((float(film.empty[i]), float(film.fill[k, i])))
            if high - low > 0.005:
                bar[0], bar[2] = x + low * wide, x + high * wide
                draw.rectangle(bar, fill=style.actuator_colour(i))
        return np.asarray(image)
