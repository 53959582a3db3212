"""Names and units of columns as logs write them, in English, German, French and Chinese."""

from __future__ import annotations

import re
import unicodedata
from typing import Literal

from piga.errors import UnitError
from piga.units import parse_unit

Kind = Literal[
    "time", "date", "counts", "angle", "rate", "force", "base-rate", "temperature", "segment", "sequence",
    "stand-angle", "stand-speed", "other",
]  # fmt: skip
"""What a column holds. ``angle`` and ``rate`` are those of the outer gimbal, ``stand-...`` those of the machine."""

_AXES = {"x": 0, "y": 1, "z": 2}
_WORDS: dict[Kind, tuple[str, ...]] = {
    "stand-speed": (
        "rpm|(?:centrifuge|table|spindle) speed",
        "drehzahl|zentrifugendrehzahl",
        "vitesse de rotation|vitesse (?:de la )?centrifugeuse",
        r"转速|离心机转速",
    ),
    "stand-angle": (
        "(?:table|head|stage|tilt) angle|table position|turntable|dividing head",
        r"tischwinkel|teilkopf\w*|tischposition|kippwinkel|drehtisch\w*",
        r"plateau|angle (?:de |du )?(?:plateau|table|diviseur)|diviseur",
        r"分度头\w*|转台\w*|台面\w*|位置角\w*",
    ),
    "temperature": ("temp|temp ?degc?|temperature|t case|t amb", r"temperatur\w*", "température", r"\w*温度"),
    "counts": (
        "n|counts?|counter|counter value|pulses?|pulse count|ticks|increments?|encoder",
        "impulse?|z[äa]e?hler(?:stand|wert)?|z[äa]e?hlwert|inkremente?",
        "compteur|comptage|impulsions?|incréments?",
        r"计数\w*|脉冲\w*",
    ),
    "rate": (
        "rate|omega|(?:precession|gimbal|output) rate",
        "drehrate|winkelgeschwindigkeit|pr[äa]e?zessionsrate|ausgangsrate",
        "vitesse angulaire|vitesse de précession",
        "角速度|角速率|进动角?速[度率]",
    ),
    "angle": (
        "psi|alpha|angle|(?:gimbal|output) angle",
        "winkel|ausgangswinkel|rahmenwinkel|pr[äa]e?zessionswinkel",
        "angle de sortie|angle de précession",
        "角度|转角|输出角|进动角",
    ),
    "time": (
        "t|ts|time|(?:waveform|elapsed|relative) time|time ?stamp|elapsed(?: time)?|seconds?|x value|clock|date ?time",
        "zeit|zeitpunkt|zeitstempel|uhrzeit|messzeit|sekunden|datum (?:und )?(?:uhr)?zeit",
        "date heure|temps|horodatage|heure|secondes|instant",
        r"时间\w*|时刻|时戳|采样时间|日期时间",
    ),
    "date": ("date", "datum", "日期"),
    "segment": (
        "segment|pos|pos(?:ition)? ?(?:nr|no|number)?|step|level|dwell|hold",
        "lage|stellung|stufe|messpunkt|abschnitt",
        "palier|étape|(?:n° ?|numéro )?(?:de )?position",
        r"位置\w*|段\w*|档位|测点",
    ),
    "sequence": (
        "seq|sequence|index|sample|sample (?:no|nr|number)|record|row|no",
        "lfd ?nr|laufende nummer|nr",
        "numéro|numero|n°|échantillon",
        r"序号|序列号|样本\w*|点号",
    ),
}
"""Names of each kind in English, German, French and Chinese, as patterns of whole plain names."""
_FORCE = (
    r"f|a|g|acc|accel|acceleration|specific force|ref|reference|beschl|beschleunigung|spezifische kraft|kraft|referenz"
    r"|acc[ée]l[ée]ration|accel|force|force sp[ée]cifique|比力|加速度|参考"
)
_RATE = r"w|om|omega|gyro|rate|base rate|ang rate|drehrate|winkelgeschwindigkeit|vitesse|vitesse angulaire|角速度|角速率|基座角速度"
_SUFFIX_UNITS = {
    "s": "s", "sec": "s", "ms": "ms", "us": "us", "min": "min", "g": "g", "mg": "mg", "ug": "ug", "mps2": "m/s^2",
    "ms2": "m/s^2", "m s2": "m/s^2", "m s 2": "m/s^2", "rad": "rad", "deg": "deg", "grad": "deg", "rad s": "rad/s",
    "rads": "rad/s", "rps": "rad/s", "deg s": "deg/s", "degs": "deg/s", "dps": "deg/s", "deg h": "deg/h", "rpm": "rpm",
    "c": "degC", "degc": "degC", "k": "K", "rev": "rev",
}  # fmt: skip
_SPEEDS = ("1/min", "min-1", "min^-1", "1/Min", "min⁻¹", "Upm", "upm")
"""Units of a speed of rotation without the revolution."""
_BRACKET = re.compile(r"\s*[\[(（【][^\])）】]*[\])）】]?\s*$")


def plain(name: str) -> str:
    """A name in small letters, without unit in brackets, with one space between its words."""
    bare = re.sub(r"#\d+$", "", unicodedata.normalize("NFKC", name).strip().lstrip("#"))
    text = _BRACKET.sub("", bare.strip())
    text = re.sub(r"(?<=[a-zäöüéè])(?=[A-Z][a-z])", " ", text)
    return " ".join(re.sub(r"[_\-./:,;]+", " ", text).casefold().split())


def unit_in_name(name: str) -> tuple[str, str]:
    """A plain name without the unit at its end, and this unit: ``fx_g`` is fx in g. Empty without one."""
    text = plain(name)
    words = text.split()
    for count in (3, 2, 1):
        unit = _SUFFIX_UNITS.get(" ".join(words[-count:])) if len(words) > count else None
        if unit is not None:
            return " ".join(words[:-count]), unit
    return text, ""


def kind_of_name(name: str) -> tuple[Kind, int | None]:
    """What a column of this name holds, and its axis (0, 1, 2 for X0, Y0, Z0) if it has one."""
    short, unit = unit_in_name(name)
    for text in dict.fromkeys((plain(name), short)):
        axis = _axis(text)
        if axis is not None:
            return axis
        for kind, words in _WORDS.items():
            if re.fullmatch("|".join(words), text):
                return (kind, None) if not (kind == "segment" and unit) else ("other", None)
    return "other", None


def _axis(text: str) -> tuple[Kind, int] | None:
    """Force or base rate along an axis: ``fx``, ``f x``, ``acc x``, ``x轴加速度``, ``beschleunigung x``."""
    kinds: tuple[tuple[Kind, str], ...] = (("force", _FORCE), ("base-rate", _RATE))
    for kind, words in kinds:
        for pattern in (
            rf"(?:{words}) ?([xyz])0?(?: ?(?:achse|axis|axe|轴))?",
            rf"([xyz])0? ?(?:achse|axis|axe|轴)?(?:向|方向)? ?(?:{words})",
        ):
            match = re.fullmatch(pattern, text)
            if match:
                return kind, _AXES[match.group(1)]
    return None


def known_unit(text: str) -> str:
    """A unit as piga reads it; empty if the text is not one."""
    bare = text.strip().strip("[]()（）【】").strip()
    if bare in _SPEEDS:
        return "rpm"
    try:
        parse_unit(bare)
    except UnitError:
        return ""
    return bare


def measures(unit: str, like: str) -> bool:
    """True if the unit measures the same quantity as ``like``."""
    return bool(unit) and parse_unit(unit).dimension == parse_unit(like).dimension


_FACTS: dict[str, tuple[str, ...]] = {
    "instrument.serial": (
        "serial(?: ?(?:number|no|nr))?|s ?n",
        "serien ?(?:nummer|nr)|ger[äa]e?t(?: ?nr)?",
        "numéro de série|n° ?(?:de )?série",
        "编号|序列号|产品编号|仪表编号",
    ),
    "instrument.scale_factor": (
        "(?:nominal )?scale ?factor",
        "skalenfaktor",
        "facteur d.échelle",
        "标度因数|比例因子",
    ),
    "instrument.counts_per_revolution": (
        "(?:counts?|pulses?)(?: per |/)(?:rev(?:olution)?|turn)|ppr|cpr",
        "(?:impulse|inkremente)(?: pro | je ?|/)(?:umdrehung|umdr)",
        "impulsions(?: par |/)tour",
        "(?:每转)?脉冲数?(?:每转|/转)|每转脉冲数?",
    ),
    "data.sample_rate": (
        "(?:sample|sampling) ?(?:rate|frequency)",
        "abtastrate|abtastfrequenz|messrate",
        "(?:fréquence|taux) d.échantillonnage",
        "采样(?:率|频率)",
    ),
    "step": ("delta x|sample interval", "abtastintervall", "采样间隔"),
    "stand.latitude": ("latitude", "breite|breitengrad|geogr(?:aphische)? breite", "纬度"),
    "stand.gravity": (
        "(?:local )?gravity",
        "schwere|fallbeschleunigung",
        "pesanteur|gravité",
        "重力(?:加速度)?",
    ),
    "stand.radius": ("(?:arm )?radius", "armlänge", "rayon", "半径"),
}
"""Names of facts in a preamble, by key of the run file."""


def fact(line: str) -> tuple[str, str] | None:
    """Key of the run file and its text, from a line of a preamble: ``Seriennummer: G-0417``. None if it is none."""
    parts = re.split(r"[:=：;\t]+|(?<=\S),(?=\s*\S)", line.strip().lstrip("#%").strip(), maxsplit=1)
    if len(parts) != 2:
        return None
    name = plain(parts[0])
    unit = re.search(r"[\[(（]([^\])）]+)[\])）]", parts[0])
    value = re.split(r"[;\t]", parts[1].strip().strip('"'))[0].strip().strip('"').rstrip(",").strip()
    for key, words in _FACTS.items():
        if value and re.fullmatch("|".join(words), name):
            return key, f"{value} {unit.group(1)}" if unit and key != "instrument.serial" else value
    return None
