"""Drawings of the manual as SVG, in the symbols of the text: ``python -m builders.drawings`` writes ``docs/figures/drawing-*.svg``.

Lengths are in pixels of the drawing, y downwards. The colours follow the reader's light or dark mode.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "figures"
STYLE = """
:root{color-scheme:light dark}
.bg{fill:#ffffff}.l{stroke:#1f2328;fill:none;stroke-width:1.6;stroke-linecap:round;stroke-linejoin:round}
.thin{stroke-width:1}.dash{stroke-dasharray:5 4}.b{stroke:#0a5ea8}.r{stroke:#b3261e}.g{stroke:#2e7d32}.n{stroke:#6e7781}
.body{fill:#eef2f6;stroke:#1f2328;stroke-width:1.4}.solid{fill:#1f2328}.fb{fill:#0a5ea8}.fr{fill:#b3261e}.fg{fill:#2e7d32}.fn{fill:#57606a}
text{font-family:system-ui,'DejaVu Sans',sans-serif;font-size:15px;fill:#1f2328}.small{font-size:13px}.head{font-weight:600}
@media(prefers-color-scheme:dark){.bg{fill:#131416}.l{stroke:#e6edf3}.b{stroke:#6cb2f0}.r{stroke:#ff8a80}.g{stroke:#81c784}.n{stroke:#8b949e}
.body{fill:#23272e;stroke:#e6edf3}.solid{fill:#e6edf3}text{fill:#e6edf3}.fb{fill:#6cb2f0}.fr{fill:#ff8a80}.fg{fill:#81c784}.fn{fill:#9aa4af}}
""".replace("\n", "")
FILLS = {"b": "fb", "r": "fr", "g": "fg", "n": "fn", "": "solid"}
"""Fill of an arrow head, by the class of its line."""

Point = tuple[float, float]


class Drawing:
    """An SVG that grows by lines, arrows, arcs and words. Words: ``_x`` is a subscript, e.g. ``a_Y`` or ``X_0``."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.width, self.height, self.title = width, height, title
        self.parts: list[str] = []

    def path(self, data: str, kind: str = "") -> None:
        """A path of the line class and the further classes ``kind``."""
        self.parts.append(f'<path class="l {kind}" d="{data}"/>')

    def line(self, *points: Point, kind: str = "") -> None:
        """A line through points."""
        self.path("M" + " L".join(f"{x:.1f} {y:.1f}" for x, y in points), kind)

    def arrow(self, start: Point, end: Point, words: str = "", kind: str = "", shift: Point = (8, 5)) -> None:
        """An arrow, with words at its end."""
        self.line(start, end, kind=kind)
        self._head(end, math.atan2(end[1] - start[1], end[0] - start[0]), kind)
        if words:
            self.text((end[0] + shift[0], end[1] + shift[1]), words, kind)

    def _head(self, tip: Point, angle: float, kind: str) -> None:
        sides = [(tip[0] - 10 * math.cos(angle + d), tip[1] - 10 * math.sin(angle + d)) for d in (-0.38, 0.38)]
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (tip, *sides))
        colour = next((FILLS[part] for part in kind.split() if part in FILLS), "solid")
        self.parts.append(f'<polygon class="{colour}" points="{points}"/>')

    def curve(self, points: Sequence[Point], kind: str = "", *, head: bool = False) -> None:
        """A line through many points, with an arrow head at its end if asked."""
        self.line(*points, kind=kind)
        if head:
            (x0, y0), (x1, y1) = points[-3], points[-1]
            self._head((x1, y1), math.atan2(y1 - y0, x1 - x0), kind)

    def arc(
        self, centre: Point, radius: float, start: float, end: float, kind: str = "", *, head: bool = True
    ) -> None:
        """An arc from angle ``start`` to ``end`` [deg], counter-clockwise positive."""
        steps = [math.radians(start + (end - start) * k / 40) for k in range(41)]
        self.curve(
            [(centre[0] + radius * math.cos(a), centre[1] - radius * math.sin(a)) for a in steps],
            kind,
            head=head,
        )

    def circle(self, centre: Point, radius: float, kind: str = "body") -> None:
        """A circle."""
        self.parts.append(f'<circle class="{kind}" cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="{radius:g}"/>')

    def box(self, corner: Point, size: Point, words: str = "", turn: float = 0.0) -> None:
        """A box with words in its middle, turned by ``turn`` [deg] counter-clockwise."""
        (x, y), (w, h) = corner, size
        middle = f"{x + w / 2:.1f} {y + h / 2:.1f}"
        self.parts.append(
            f'<rect class="body" x="{x}" y="{y}" width="{w}" height="{h}" rx="4" transform="rotate({-turn:g} {middle})"/>'
        )
        if words:
            lines = words.split("|")
            for k, line in enumerate(lines):
                self.text((x + w / 2, y + h / 2 + 5 + 18 * (k - (len(lines) - 1) / 2)), line, anchor="middle")

    def text(self, at: Point, words: str, kind: str = "", anchor: str = "start") -> None:
        """Words at a place; ``kind`` of a line gives them its colour."""
        colour = " ".join(FILLS.get(part, part) for part in kind.split() if part not in ("thin", "dash"))
        body = re.sub(
            r"_(\w+)", r'<tspan dy="4" font-size="72%">\1</tspan><tspan dy="-4">&#8203;</tspan>', escape(words)
        )
        self.parts.append(
            f'<text class="{colour}" x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}">{body}</text>'
        )

    def svg(self) -> str:
        """The file."""
        size = f'viewBox="0 0 {self.width} {self.height}" width="{self.width}" height="{self.height}"'
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="{escape(self.title)}">'
            f"<title>{escape(self.title)}</title><style>{STYLE}</style>"
            f'<rect class="bg" width="100%" height="100%"/>{"".join(self.parts)}</svg>\n'
        )


def isometric(origin: Point, x: float, y: float, z: float) -> Point:
    """A point in space on the drawing: x up, y to the lower left, z to the lower right (right-handed)."""
    c, s = math.cos(math.radians(30)), 0.5
    return origin[0] + c * (z - y), origin[1] - x + s * (y + z)


def instrument() -> Drawing:
    """The instrument with its frames, the rotor axis and the pendulous mass."""
    d = Drawing(
        880, 520, "The instrument: frames, gimbal angle alpha, rotor axis tilted by beta, pendulous mass"
    )
    at: Callable[..., Point] = lambda x, y, z: isometric((330, 285), x, y, z)  # noqa: E731
    turn = math.radians(35)
    y1, z1 = (math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn))
    ring = [at(0, 120 * math.cos(a), 120 * math.sin(a)) for a in [k * math.pi / 60 for k in range(121)]]
    d.curve(ring, "n thin")
    d.arrow(at(-60, 0, 0), at(235, 0, 0), "X_0 = X_1: input axis, axis of the outer gimbal")
    d.arrow(at(0, 0, 0), at(0, 205, 0), "Y_0", "n", (-34, 8))
    d.arrow(at(0, 0, 0), at(0, 0, 205), "Z_0", "n")
    d.arrow(at(0, 0, 0), at(0, 180 * y1[0], 180 * y1[1]), "Y_1: axis of the inner gimbal", "b", (-60, 20))
    d.arrow(at(0, 0, 0), at(0, 190 * z1[0], 190 * z1[1]), "Z_1", "b", (8, 16))
    arc = [at(0, 78 * math.cos(a), 78 * math.sin(a)) for a in [turn * k / 20 for k in range(21)]]
    d.curve(arc, "b", head=True)
    d.text((at(0, 92, 30)[0] - 2, at(0, 92, 30)[1] + 16), "α", "b")
    beta = math.radians(16)
    tip = at(190 * math.sin(beta), 190 * math.cos(beta) * z1[0], 190 * math.cos(beta) * z1[1])
    d.arrow(at(0, 0, 0), tip, "z: rotor axis", "r", (8, -4))
    tilt = [
        at(150 * math.sin(b), 150 * math.cos(b) * z1[0], 150 * math.cos(b) * z1[1])
        for b in [beta * k / 12 for k in range(13)]
    ]
    d.curve(tilt, "r")
    d.text((tilt[6][0] + 8, tilt[6][1] + 5), "β", "r")
    rotor = [
        at(
            50 * math.cos(a) * math.cos(beta),
            *(50 * math.sin(a) * y1[k] - 50 * math.cos(a) * math.sin(beta) * z1[k] for k in (0, 1)),
        )
        for a in [k * math.pi / 40 for k in range(81)]
    ]
    d.curve(rotor, "r")
    mass = at(62 * math.sin(beta), 62 * math.cos(beta) * z1[0], 62 * math.cos(beta) * z1[1])
    d.circle(mass, 9, "solid")
    d.line((mass[0] + 3, mass[1] - 10), (mass[0] + 22, mass[1] - 66), kind="n thin")
    d.text((mass[0] + 6, mass[1] - 72), "pendulous mass: m l")
    d.text(
        (20, 478),
        "H: angular momentum along z.   K = m l / H.   The output is the angle α of the outer gimbal about X_0,",
    )
    d.text((20, 502), "positive from Y_0 to Z_0. It is read as ψ from an arbitrary zero:  α = ψ + φ.")
    return d


def effective_axis() -> Drawing:
    """The axis along which the instrument measures, on its cone."""
    d = Drawing(880, 360, "The effective input axis turns on a cone of half angle beta about X0")
    top, foot = 70, 290
    centre = (220, foot)
    d.arrow((220, 320), (220, 40), "X_0", "n")
    ellipse = [
        (220 + 95 * math.cos(a), top + 30 - 22 * math.sin(a)) for a in [k * math.pi / 40 for k in range(81)]
    ]
    d.curve(ellipse, "b thin dash")
    d.line(centre, (125, top + 30), kind="n thin dash")
    d.line(centre, (315, top + 30), kind="n thin dash")
    axis = (220 + 95 * math.cos(0.6), top + 30 + 22 * math.sin(0.6))
    d.arrow(centre, axis, "n(α)", "b", (10, 4))
    d.arc(centre, 120, 90, 68, "r", head=False)
    d.text((236, 160), "β", "r")
    d.curve(ellipse[4:26], "b", head=True)
    d.text((330, top + 4), "turns with α: one turn of the gimbal is one turn on the cone", "b")
    d.text((380, 170), "The output rate is K f · n(α):")
    d.text((380, 200), "α′ = K ( a_x + tan β ( a_Y sin α − a_Z cos α ) )", "head")
    d.text((380, 232), "Along X_0 it reads a_x. Across it, transverse force")
    d.text((380, 254), "leaks in once a turn. It averages out only if the")
    d.text((380, 276), "gimbal turns evenly, and it does not: near")
    d.text((380, 298), "|a_x| = a_t tan β the gimbal stands still (it locks).")
    return d


def dividing_head() -> Drawing:
    """A dividing head: angle, axes, force and azimuth."""
    d = Drawing(880, 400, "Dividing head: position x turns the instrument about Z0; f = g (cos x, -sin x, 0)")
    c, x = (230, 200), math.radians(35)
    d.circle(c, 130)
    d.circle(c, 5, "solid")
    d.arrow(c, (230, 40), "up: f = g", "r", (8, 4))
    d.line(c, (230, 62), kind="n thin dash")
    tip = (230 - 118 * math.sin(x), 200 - 118 * math.cos(x))
    d.arrow(c, tip, "X_0", "b", (-42, -12))
    d.arrow(c, (230 - 118 * math.cos(x), 200 + 118 * math.sin(x)), "Y_0", "b", (-38, 20))
    d.text((242, 222), "Z_0 towards you", "b")
    d.arc(c, 92, 90, 125, "g")
    d.text((196, 96), "x", "g")
    d.text((100, 372), "seen along the axis of the head")
    d.text((430, 90), "At position x the force in the axes of the instrument is", "")
    d.text((430, 120), "a_x = g cos x,   a_Y = − g sin x,   a_Z = 0", "head")
    d.text((430, 156), "Position 0: X_0 points up. Positive x turns X_0")
    d.text((430, 178), "towards Y_0 (right-handed about Z_0).")
    d.text((430, 214), "azimuth: direction of Z_0, the axis of the head,")
    d.text((430, 236), "from north over east. 0 if it is not given.")
    d.text((430, 272), "Near x = 90° and 270° the gimbal locks: leave")
    d.text((430, 294), "these positions out.")
    return d


def centrifuge() -> Drawing:
    """A centrifuge from above."""
    d = Drawing(880, 380, "Centrifuge from above: X0 inward, Y0 against the motion, Z0 up")
    c, at = (190, 200), (330, 200)
    d.circle(c, 140, "l n thin dash")
    d.circle(c, 14)
    d.line(c, at)
    d.box((308, 178), (44, 44))
    d.arrow((330, 200), (252, 200), "X_0", "b", (-8, -10))
    d.arrow((330, 200), (330, 276), "Y_0", "b", (8, 6))
    d.circle((330, 200), 5, "fb")
    d.text((358, 190), "Z_0 up", "b")
    d.arc(c, 60, 20, 110, "g")
    d.text((168, 128), "Ω > 0", "g")
    d.line((190, 226), (330, 226), kind="n thin")
    d.text((244, 246), "r", "n")
    d.text((430, 90), "Seen from above. On the arm:")
    d.text((430, 120), "f = ( r Ω²,  − r Ω′,  g )", "head")
    d.text((430, 156), "X_0 points to the spindle, so the force is positive.")
    d.text((430, 178), "outward = true turns X_0 away from it: then it is")
    d.text((430, 200), "negative. Measure both for k_0 and k_2.")
    d.text((430, 236), "Ramps between the levels are not used. A tilt of the")
    d.text((430, 258), "arm by 1″ adds 4.8 µg to every level: state it.")
    return d


def rate_table() -> Drawing:
    """A rate table with a vertical axis."""
    d = Drawing(880, 330, "Rate table: the base turns about X0")
    d.box((90, 220), (240, 24))
    d.box((180, 244), (60, 40))
    d.box((175, 150), (70, 70))
    d.arrow((210, 185), (210, 50), "X_0 = axis of the table", "b")
    ellipse = [
        (210 + 70 * math.cos(a), 100 - 14 * math.sin(a)) for a in [k * math.pi / 40 for k in range(-30, 31)]
    ]
    d.curve(ellipse, "g", head=True)
    d.text((290, 104), "Ω_x", "g")
    d.text((400, 90), "The gimbal keeps its direction in space, so the output")
    d.text((400, 112), "shows the rate of the base with the opposite sign:")
    d.text((400, 144), "α′ = K a_x − Ω_x + coupling", "head")
    d.text((400, 180), "It checks sign, counts per revolution and time scale.")
    d.text((400, 202), "With a horizontal axis gravity turns in the base,")
    d.text((400, 224), "and every position of a head is passed once a turn.")
    return d


def vibration_table() -> Drawing:
    """A vibration table."""
    d = Drawing(880, 330, "Vibration table: rectification shows k2")
    d.box((120, 200), (180, 60), "shaker")
    d.box((150, 176), (120, 24))
    d.box((175, 106), (70, 70))
    d.arrow((210, 140), (210, 40), "X_0", "b")
    d.arrow((320, 150), (320, 96), "", "g")
    d.arrow((320, 150), (320, 204), "a sin ω t", "g", (10, -48))
    d.text((430, 96), "Vibration along X_0 with the mean square ⟨a²⟩")
    d.text((430, 118), "shifts the mean output:")
    d.text((430, 150), "Δ a_x = k_2 ⟨a²⟩", "head")
    d.text((430, 186), "So k_2 is seen without a centrifuge. Along another")
    d.text((430, 208), "axis k_YY or k_ZZ is seen, between two axes k_XY.")
    d.text((430, 230), "Keep the frequency below the band of the servo.")
    return d


def triad() -> Drawing:
    """Three instruments in one body."""
    d = Drawing(880, 380, "A triad: three instruments, the directions of their input axes and gimbals")
    at: Callable[..., Point] = lambda x, y, z: isometric((230, 220), x, y, z)  # noqa: E731
    for axis, word in (((1, 0, 0), "x"), ((0, 1, 0), "y"), ((0, 0, 1), "z")):
        d.arrow(
            at(0, 0, 0),
            at(*(170 * v for v in axis)),
            f"body {word}",
            "n",
            (10, 6) if word != "y" else (-62, 10),
        )
        end = at(
            *(
                150 * v + 26 * (k == 1 and word == "x") + 22 * (k == 0 and word != "x")
                for k, v in enumerate(axis)
            )
        )
        d.arrow(at(0, 0, 0), end, f"X_0 of {word}", "b", {"x": (-64, 0), "y": (-70, -6), "z": (12, 2)}[word])
    d.text((430, 100), "Each instrument reads K_i f · n_i(α_i).")
    d.text((430, 130), "n_i is known from its mounting and its own")
    d.text((430, 152), "calibration, α_i from its output.")
    d.text((430, 188), "Three readings give the three components of f:", "head")
    d.text((430, 214), "no other reference is needed.")
    d.text((430, 250), "Four or more, skewed: the same by least squares.")
    return d


def platform() -> Drawing:
    """The platform with its two gyros."""
    d = Drawing(
        880, 420, "The space-stable platform: two gyros with turning cases, redundancy ring, three gimbals"
    )
    d.box((40, 60), (330, 290))
    d.text((52, 82), "platform P (held by three gimbals)", "n")
    d.box((80, 110), (110, 96), "polar gyro|h_1 along z_P")
    d.box((226, 196), (120, 96), "equatorial gyro|h_2 near x_P")
    d.parts.append('<rect class="l r dash" x="214" y="170" width="146" height="138" rx="60"/>')
    d.text((196, 332), "ring: turn Y about y_P", "r")
    d.arc((135, 110), 20, 180, 0, "g")
    d.text((164, 104), "c_1, w_c", "g")
    d.arc((286, 186), 22, 200, -20, "g")
    d.text((312, 166), "c_2, w_c", "g")
    d.arrow((70, 330), (70, 250), "z_P", "b")
    d.arrow((70, 330), (150, 330), "x_P", "b", (6, 5))
    d.text((410, 96), "The cases turn at w_c, so that drifts fixed to the case")
    d.text((410, 118), "average out. The price: a case that is not square to its")
    d.text((410, 140), "axis (misalignment m_1, m_2) swings the platform:")
    d.text((410, 172), "e_x = m_1 cos c_1,   e_y = m_1 sin c_1", "head")
    d.text((410, 198), "e_z = m_2 sin c_2 / cos η − m_1 cos c_1 tan η", "head")
    d.text((410, 234), "η, the redundancy angle, couples the two gyros.")
    d.text((410, 256), "It grows over ten days, and so does the error.")
    d.text((410, 292), "Gimbals from outside: azimuth ψ, middle θ, polar σ.")
    return d


def servo_loop() -> Drawing:
    """Block diagram of the servo loop."""
    d = Drawing(880, 300, "The servo loop: a torque on the outer gimbal keeps the rotor axis at its null")
    d.box((170, 90), (140, 60), "float|c, J_y")
    d.box((400, 90), (150, 60), "outer gimbal|J_x, H")
    d.box((270, 200), (150, 56), "servo|k_p, k_i, k_d")
    d.arrow((50, 120), (170, 120))
    d.text((50, 108), "m l a_x", "b")
    d.arrow((310, 120), (400, 120))
    d.text((350, 110), "β", "r")
    d.arrow((550, 120), (760, 120), "α: output")
    d.line((650, 120), (650, 50), (140, 50))
    d.arrow((140, 50), (140, 118))
    d.text((300, 42), "H α′: gyroscopic torque", "n")
    d.arrow((345, 120), (345, 200))
    d.line((420, 228), (475, 228))
    d.arrow((475, 228), (475, 150))
    d.text((486, 196), "torque of the motor", "n")
    d.text(
        (50, 290),
        "Gravity across X_0 pulls on the mass once a turn. The loop gives way a little: the term servo.",
        "small",
    )
    return d


def data_flow() -> Drawing:
    """From a log to numbers that are used."""
    d = Drawing(880, 250, "Flow of data: log, run file, calibration, what follows")
    names = ["log|CSV, XLSX …", "run file|TOML", "checked|record", "calibration|K, tan β, k_0 …"]
    for k, name in enumerate(names):
        d.box((20 + 190 * k, 40), (150, 64), name)
        if k:
            d.arrow((170 + 190 * (k - 1), 72), (20 + 190 * k, 72))
    for k, word in enumerate(("piga init", "piga check", "piga calibrate")):
        d.text((190 + 190 * k, 34), word, "fb small", "middle")
    for k, (name, word) in enumerate(
        (
            ("report", "--report"),
            ("certificate", "piga certificate"),
            ("corrected force", "piga compensate"),
            ("trend", "piga records"),
        )
    ):
        d.box((20 + 190 * k, 176), (150, 48), name)
        d.line((665, 104), (665, 140), (95 + 190 * k, 140))
        d.arrow((95 + 190 * k, 140), (95 + 190 * k, 176))
        d.text((103 + 190 * k, 164), word, "fb small")
    return d


DRAWINGS = (
    instrument, effective_axis, dividing_head, centrifuge, rate_table, vibration_table, triad, platform, servo_loop, data_flow,
)  # fmt: skip


def main() -> None:
    """Write all drawings."""
    for make in DRAWINGS:
        (FOLDER / f"drawing-{make.__name__.replace('_', '-')}.svg").write_text(make().svg(), "utf-8")


if __name__ == "__main__":
    main()
