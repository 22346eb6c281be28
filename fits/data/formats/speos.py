"""ANSYS Speos BSDFs as text: `.brdf`, isotropic, and `.anisotropicbsdf`.

Both are tables over the polar angle from the normal (above 90 degrees: transmitted) and the azimuth of the viewer, from
where the light's own direction of travel points: the mirror direction is at azimuth 0 whatever the sample's rotation.
The anisotropy angle is the azimuth, from there, of the vector that marks the sample. Rows as in "Structure of BRDF
files" and "Structure of anisotropic BSDF files" of the Speos manual, angles as in its "Anisotropic BSDF surface
overview".

Tables are in any unit, of BSDFs or of intensities, which are BSDFs times |cos theta| of the viewer. Speos scales them
to the shares of light that stand beside them in percent, and so does this reader: each table of a `.brdf` to its own,
all tables of one side of an `.anisotropicbsdf` by one factor for each wavelength, that of the incidence where the
spectrum was measured. Shares are summed over the table, linear between its nodes.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from fits.data.formats._rows import Rows
from fits.data.formats._text import plural, read_lines, require_range, require_room, without_mark
from fits.data.geometry import LIGHT_AZIMUTH, TANGENT_COSINE, Floats, direction
from fits.data.measurements import Measurements, Source, channel_names, to_bsdf
from fits.names import Quantity

MAGIC = b"OPTIS"
_MOST = 100_000
_END = "End of file"
"""Last line of files, with or without it."""
Side = Literal["reflection", "transmission"]


@dataclass(frozen=True)
class Table:
    """Values (T, P) over polar angles (T,) and azimuths (P,) of the viewer, for one direction of the light."""

    rotation: float
    incidence: float
    theta: Floats
    phi: Floats
    values: Floats

    @property
    def side(self) -> Side:
        """Azimuth of the viewer, from that of the light."""
        return "transmission" if self.theta.max() > 90.0 else "reflection"

    def share(self, quantity: Quantity) -> float:
        """The integral of BSDF times |cos theta|, linear between the nodes; 1 is all light."""
        over_phi = _mean(self.phi, self.values)
        return float(2.0 * np.pi * np.sum(_weights(self.theta, quantity) * over_phi))


@dataclass
class _Spectrum:
    """Shares (L,) at wavelengths (L,) in nm, measured at a polar angle and rotation of the light."""

    theta: float
    phi: float
    wavelengths: Floats
    shares: Floats


@dataclass
class _Header:
    reflects: bool
    transmits: bool
    quantity: Quantity
    incidences: dict[Side, list[tuple[float, float]]] = field(default_factory=dict)

    @property
    def sides(self) -> list[Side]:
        pairs: list[tuple[Side, bool]] = [("reflection", self.reflects), ("transmission", self.transmits)]
        return [side for side, there in pairs if there]


def recognises(head: bytes) -> bool:
    """Whether a file starts as one of Speos' (then OPTIS') tables."""
    return head.lstrip().startswith(MAGIC)


def read(path: Path) -> Measurements:
    """Read such a file; channels are wavelengths where it has several that differ. Errors as in `fits.read`."""
    head = without_mark(path.read_bytes())[:10_000]
    if not recognises(head):
        raise ValueError(f"{path}: a Speos BSDF starts with 'OPTIS - ...'")
    above = len(head[: len(head) - len(head.lstrip())].splitlines())
    mode = b"".join(head.splitlines()[above + 1 : above + 2]).strip()[:1]
    if mode == b"1":
        raise ValueError(
            f"{path}, line {above + 2}: a binary file, which has no reader here; Speos' viewers save it as text"
        )
    if mode != b"0":
        raise ValueError(f"{path}, line {above + 2}: must be 0 for text, or 1 for binary")
    lines = Rows(path, read_lines(path, "latin-1"))
    title = lines.filled("the title").text.lower()
    lines.text("the mode")
    lines.text("a comment")
    lines.skip_text(lines.whole("the length of the description", (0, 1_000_000)))
    if "anisotropic" in title:
        return _read_anisotropic(path, lines)
    if "brdf" in title:
        return _read_isotropic(path, lines)
    raise ValueError(f"{path}: the title is {title[:60]!r}, must be a brdf or an anisotropic BSDF surface file")


def _start(lines: Rows) -> _Header:
    """The two lines that say which sides there are and what the values are."""
    flags = lines.numbers(2, "whether there are reflection and transmission", (0, 1))
    if not flags.any():
        raise lines.last.error("neither reflection nor transmission, must be one of them at least")
    proportional = lines.numbers(1, "1 for BSDFs or 0 for intensities", (0, 1))
    return _Header(bool(flags[0]), bool(flags[1]), "brdf" if proportional[0] else "brdf_cos")


def _table(lines: Rows, rotation: float, incidence: float) -> Table:
    counts = lines.numbers(2, "counts of theta and phi", (1, _MOST))
    if (counts != counts.astype(int)).any():
        raise lines.last.error("counts of theta and phi must be whole numbers")
    rows, columns = (int(count) for count in counts)
    phi = lines.numbers(columns, "azimuths", (-360.0, 720.0))
    place = lines.last
    body, numbers = lines.table(rows, 1 + columns, "a row of a table")
    theta = numbers[:, 0]
    require_range(body, theta, "theta", (0.0, 180.0))
    if (np.diff(theta) <= 0).any() or (np.diff(phi) <= 0).any():
        raise place.error("angles of this table do not rise")
    if theta[0] < 90.0 < theta[-1]:
        raise place.error(f"polar angles from {theta[0]:g} to {theta[-1]:g} in one table, must be on one side of 90")
    return Table(rotation, incidence, theta, phi, numbers[:, 1:])


def _read_isotropic(path: Path, lines: Rows) -> Measurements:
    header = _start(lines)
    counts = lines.numbers(2, "counts of incidences and wavelengths", (1, _MOST)).astype(int)
    incidences = lines.numbers(int(counts[0]), "incidences", (0.0, 90.0))
    wavelengths = lines.numbers(int(counts[1]), "wavelengths", (0.0, 1e6))
    names = tuple(f"{one:.12g} nm" for one in wavelengths) if len(wavelengths) > 1 else channel_names(1)
    scaled: dict[Side, list[list[Floats]]] = {side: [] for side in header.sides}
    nodes: dict[Side, list[Table]] = {side: [] for side in header.sides}
    factors = []
    for _ in range(len(header.sides) * counts[0] * counts[1]):
        percent = lines.numbers(1, "a percentage", (0.0, 1e6))[0]
        place = lines.last
        table = _table(lines, 0.0, 0.0)
        side = table.side
        if side not in scaled or (len(nodes[side]) == counts[0] and len(scaled[side][-1]) == counts[1]):
            raise place.error(f"a table of {side} too many")
        if not scaled[side] or len(scaled[side][-1]) == counts[1]:
            incidence = float(incidences[len(nodes[side])])
            nodes[side].append(Table(0.0, incidence, table.theta, table.phi, table.values))
            scaled[side].append([])
        first = nodes[side][-1]
        if not (np.array_equal(first.theta, table.theta) and np.array_equal(first.phi, table.phi)):
            raise place.error("tables of one incidence have different angles at different wavelengths")
        factors.append(_factor(0.01 * percent, table.share(header.quantity)))
        scaled[side][-1].append(factors[-1] * table.values.ravel())
    lines.end(allowed=_END)
    parts = [
        _samples(table, np.stack(values, axis=-1), header.quantity)
        for side in header.sides
        for table, values in zip(nodes[side], scaled[side], strict=True)
    ]
    return _measurements(
        path, parts, names, header, factors, ["angles as in anisotropic files: light from azimuth 180"]
    )


def _read_anisotropic(path: Path, lines: Rows) -> Measurements:
    lines.numbers(3, "the vector that marks the sample")
    header = _start(lines)
    for side in header.sides:
        rotations = lines.counted("rotations of the sample", (-360.0, 360.0))
        header.incidences[side] = [
            (float(rotation), float(incidence))
            for rotation in rotations
            for incidence in lines.counted("incidences", (0.0, 90.0))
        ]
    spectra: dict[Side, _Spectrum] = {}
    for side in header.sides:
        theta, phi = lines.numbers(2, f"the direction where the {side} was measured", (-360.0, 360.0))
        lines.text("a description of the spectrum")
        count = lines.whole("the number of wavelengths", (1, _MOST))
        _, pairs = lines.table(count, 2, "a wavelength and a percentage")
        spectra[side] = _Spectrum(theta, phi, pairs[:, 0], 0.01 * pairs[:, 1])
        if (pairs[:, 1] < 0).any() or (np.diff(pairs[:, 0]) < 0).any():
            raise lines.last.error("wavelengths of this spectrum do not rise, or a percentage is negative")
    tables: dict[Side, list[Table]] = {}
    for side in header.sides:
        tables[side] = [_table(lines, *pair) for pair in header.incidences[side]]
        if any(table.side != side for table in tables[side]):
            raise lines.last.error(f"polar angles of a table of {side} lie on the other side")
    lines.end(allowed=_END)
    wavelengths = np.unique(np.concatenate([one.wavelengths for one in spectra.values()]))
    if all(np.ptp(one.shares) <= 1e-9 * one.shares.max() for one in spectra.values()):
        wavelengths = wavelengths[:1]
    names = tuple(f"{one:.12g} nm" for one in wavelengths) if len(wavelengths) > 1 else channel_names(1)
    require_room(path, sum(table.values.size for side in header.sides for table in tables[side]), len(names))
    parts, factors = [], []
    for side in header.sides:
        spectrum = spectra[side]
        share = np.interp(wavelengths, spectrum.wavelengths, spectrum.shares)
        reference = _reference(tables[side], spectrum, header.quantity)
        factor = np.array([_factor(one, reference) for one in share])
        factors += list(factor)
        parts += [_samples(table, table.values.ravel()[:, None] * factor, header.quantity) for table in tables[side]]
    note = "the vector that marks the sample is azimuth 0; rotations taken as counter-clockwise from the light's travel"
    return _measurements(path, parts, names, header, factors, [note])


def _reference(tables: list[Table], spectrum: _Spectrum, quantity: Quantity) -> float:
    """The share that tables hold at the incidence where the spectrum was measured, linear between two."""
    rotations = np.array([table.rotation for table in tables])
    nearest = rotations[np.argmin(abs(rotations - spectrum.phi))]
    chosen = sorted((table for table in tables if table.rotation == nearest), key=lambda table: table.incidence)
    shares = [table.share(quantity) for table in chosen]
    return float(np.interp(spectrum.theta, [table.incidence for table in chosen], shares))


def _factor(wanted: float, share: float) -> float:
    """Scale of values; 1 where a table holds nothing that could be scaled."""
    return wanted / share if share > 0.0 else 1.0


def _samples(table: Table, values: Floats, quantity: Quantity) -> tuple[Floats, Floats, Floats]:
    """wi and wo (T P, 3) and BSDFs (T P, C); what the file repeats, at the pole and after a turn, is taken once."""
    once = np.ones((len(table.theta), len(table.phi)), bool)
    once[(table.theta % 180.0) == 0.0, 1:] = False
    once[:, table.phi >= table.phi[0] + 360.0] = False
    theta, phi = np.meshgrid(table.theta, table.phi - table.rotation, indexing="ij")
    keep = once.ravel()
    wo = direction(theta, phi).reshape(-1, 3)[keep]
    wi = np.broadcast_to(direction(table.incidence, LIGHT_AZIMUTH - table.rotation), wo.shape)
    return wi, wo, to_bsdf(values[keep], wo, quantity)


def _measurements(
    path: Path,
    parts: list[tuple[Floats, Floats, Floats]],
    names: tuple[str, ...],
    header: _Header,
    factors: list[float],
    notes: list[str],
) -> Measurements:
    wi, wo, values = (np.concatenate(one) for one in zip(*parts, strict=True))
    used = np.minimum(abs(wi[:, 2]), abs(wo[:, 2])) > TANGENT_COSINE
    what = "BSDFs" if header.quantity == "brdf" else "intensities"
    notes = [
        *notes,
        f"{what}, scaled by {min(factors):.4g} to {max(factors):.4g} to the shares of light that the file states",
    ]
    if not used.all():
        notes.append(f"masked: {plural(int((~used).sum()), 'sample')} in the tangent plane")
    return Measurements(wi, wo, values, None, used, names, Source(str(path), "speos", header.quantity, tuple(notes)))


def _mean(phi: Floats, values: Floats) -> Floats:
    """The mean (T,) over a turn of values (T, P), linear in between: of a part of it, as the rest is by symmetry."""
    if len(phi) == 1:
        return values[:, 0]
    gap = 360.0 - (phi[-1] - phi[0])
    if 1e-9 < gap < 1.5 * np.diff(phi).max():  # a whole turn whose end is not repeated
        phi, values = np.append(phi, phi[0] + 360.0), np.concatenate([values, values[:, :1]], axis=1)
    mean: Floats = np.trapezoid(values, phi, axis=1) / (phi[-1] - phi[0])
    return mean


def _weights(theta: Floats, quantity: Quantity) -> Floats:
    """Weights (T,) of an integral over sin theta, times |cos theta| for BSDFs, of what is linear between the nodes."""
    if len(theta) == 1:
        return np.array([0.5 if quantity == "brdf" else 1.0])
    nodes, gauss = np.polynomial.legendre.leggauss(5)
    share = 0.5 * (1.0 + nodes)  # of the way from one node to the next
    low, step = np.radians(theta[:-1, None]), np.radians(np.diff(theta)[:, None])
    angle = low + step * share
    density = 0.5 * gauss * step * np.sin(angle) * (abs(np.cos(angle)) if quantity == "brdf" else 1.0)
    weights = np.zeros(len(theta))
    weights[:-1] += np.sum(density * (1.0 - share), axis=1)
    weights[1:] += np.sum(density * share, axis=1)
    return weights
