"""`meshskin calibrate RECORDING --out DIR`: a skin's map from a robot's own log."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration
    from ..recording.recording import Recording
    from ..scene.belief import Belief

LOG = """
RECORDING is the common part of its files' names, or a folder with contacts.csv (time, px, py, pz,
force, and qw, qx, qy, qz where the indenter's offset is unknown: one row a frame in contact, points
in the body's frame) and readings.csv (time, taxel, pressure). Columns are in SI units, or name
theirs: px_mm, pressure_kpa, time_ms.
"""


KNOWN = ("body", "units", "indenter_radius_mm", "young_kpa", "poisson", "thickness_mm")
"""Options that a scene takes the place of."""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "calibrate", help="calibrate a skin from a recorded log of contacts", description=LOG
    )
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="the log, see above")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="for the results")
    parser.add_argument(
        "--scene", help="a scene's name or file, in place of body, indenter and material"
    )
    known = parser.add_argument_group("what is known of the robot")
    known.add_argument("--body", type=Path, metavar="MESH", help="mesh that the skin covers")
    known.add_argument("--units", help="of the mesh: m, cm, mm or in")
    known.add_argument("--indenter-radius-mm", type=float, metavar="R", help="of the sphere")
    known.add_argument("--young-kpa", type=float, metavar="E", help="Young's modulus, roughly")
    known.add_argument("--poisson", type=float, help="of the skin (default 0.49)")
    known.add_argument("--thickness-mm", type=float, help="of the soft layer on rigid ground")
    known.add_argument(
        "--contact",
        help="contact model: hertz, elliptic, layered, or the first of these that holds",
    )
    known.add_argument("--disc-radius-mm", type=float, help="of a taxel (default 2)")
    known.add_argument("--noise-kpa", type=float, help="standard deviation of a reading")
    known.add_argument("--threshold-kpa", type=float, help="pressures up to this are not reported")
    known.add_argument("--saturation-kpa", type=float, help="end of the sensor's range")
    known.add_argument("--taxels", type=Path, metavar="FILE", help="skin file that names them all")
    known.add_argument(
        "--modules", action="store_true", help="taxels in rigid triangles, id = 12 module + slot"
    )
    known.add_argument(
        "--unknown", nargs="*", metavar="NAME", help="what is estimated beside the taxels: "
        "modulus (default), gain, offset, force_scale, force_offset, indenter_offset, body_offset",
    )  # fmt: skip
    parser.add_argument("--method", default="joint", help="joint (default), posegraph, ...")
    parser.add_argument(
        "--export", type=Path, metavar="FILE", help="the skin map for the robot: by suffix .txt "
        "(iCub position file), .csv, .urdf, .ply or .glb",
    )  # fmt: skip
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Calibrate, write the results, and print the summary."""
    from ..core.atomic_io import check_folder, check_place, write_json
    from ..core.provenance import provenance
    from ..estimation.calibrate import calibrate
    from ..pipeline import forget
    from ..recording.recording import Recording
    from ..skin.files import check_format

    if options.export is not None:
        check_format(options.export.suffix.lstrip("."))
    clock = perf_counter()
    recording = Recording.load(options.recording)
    belief = believed(options, recording)
    check_folder(options.out)
    if options.export is not None:
        check_place(options.export)
    found = calibrate(recording, belief, method=options.method)
    forget(options.out)
    found.save(options.out / "calibration")
    if options.export is not None:
        export(found, belief, options.export)
    metrics = assess(found, recording)
    found.report(
        options.out / "report.html",
        body=belief.body,
        recording=recording,
        metrics=metrics,
        seconds=found.seconds,
        provenance=provenance(recording=str(options.recording)),
    )
    metrics["seconds"] = {**found.seconds, "all": perf_counter() - clock}
    write_json(options.out / "metrics.json", metrics)
    print(summary(found, metrics, options.out))
    return 0


def believed(options: argparse.Namespace, recording: Recording) -> Belief:
    """What the options say of the robot. Raises ConfigError for what they lack."""
    from ..skin import slots

    belief = _by_scene(options) if options.scene else _by_options(options)
    kilo = {
        "noise_sigma": options.noise_kpa,
        "threshold": options.threshold_kpa,
        "saturation": options.saturation_kpa,
    }
    changes: dict[str, Any] = {k: 1e3 * v for k, v in kilo.items() if v is not None}
    if options.disc_radius_mm is not None:
        changes["disc_radius"] = 1e-3 * options.disc_radius_mm
    if options.contact is not None:
        changes["contact"] = options.contact
    if options.unknown is not None:
        changes["unknown"] = tuple(options.unknown)
    if options.modules:
        changes["module_slots"] = slots.OFFSETS
    if options.taxels is not None:
        from ..skin.skin import Skin

        changes["taxel_ids"] = np.array(Skin.load(options.taxels).ids)
    elif not options.scene:
        every = recording.metadata.get("taxel_ids") or np.unique(recording.reading_taxel)
        changes["taxel_ids"] = np.array(every, dtype=int)
    return replace(belief, **changes)


def _by_scene(options: argparse.Namespace) -> Belief:
    """The belief of a scene, which knows body, indenter and material."""
    from ..scene.scene import Scene

    twice = [name for name in KNOWN if getattr(options, name) is not None]
    if twice:
        named = ", ".join(f"--{name.replace('_', '-')}" for name in twice)
        raise ConfigError(
            "the scene knows body, indenter and material", value=f"{named} beside --scene",
            remedy="leave one of the two out",
        )  # fmt: skip
    return Scene.load(options.scene).belief()


def _by_options(options: argparse.Namespace) -> Belief:
    """A belief without a scene."""
    from ..contact import AUTO
    from ..contact.indenter import Indenter
    from ..contact.material import Material
    from ..geometry.body import Body
    from ..scene.belief import Belief

    needed = {
        "--body": options.body,
        "--indenter-radius-mm": options.indenter_radius_mm,
        "--young-kpa": options.young_kpa,
    }
    missing = [name for name, value in needed.items() if value is None]
    if missing:
        raise ConfigError(
            f"what is known of the robot lacks {', '.join(missing)}",
            remedy="give a --scene, or all of --body, --indenter-radius-mm and --young-kpa",
        )
    poisson = 0.49 if options.poisson is None else options.poisson
    thickness = None if options.thickness_mm is None else 1e-3 * options.thickness_mm
    return Belief(
        body=Body.load(options.body, units=options.units),
        indenter=Indenter.sphere(1e-3 * options.indenter_radius_mm),
        material=Material(1e3 * options.young_kpa, poisson, thickness),
        taxel_ids=np.empty(0, dtype=int),
        contact=AUTO,
    )


def export(found: Calibration, belief: Belief, path: Path) -> None:
    """Write the map of the taxels that are determined. Raises SkinError, OutputError."""
    from ..skin.skin import Skin

    good = np.isfinite(found.poses).all(axis=(1, 2))
    if not good.any():
        raise CalibrationError("no taxel is determined: there is no map to export")
    Skin(found.poses[good], found.ids[good], belief.disc_radius).save(path)


def assess(found: Calibration, recording: Recording) -> dict[str, Any]:
    """The numbers of metrics.json: what is known without the truth."""
    from ..estimation.uncertainty.metrics import undetermined

    good = found.observed[:, :2].all(axis=1)
    sigma = 1e3 * found.position_sigma[good]
    return {
        "method": found.method,
        "taxels": len(found.ids),
        "touched": int(found.touched.sum()),
        "determined": int(good.sum()),
        "contacts": len(recording.time),
        "readings": len(recording.pressure),
        "sigma_mm": {"mean": float(sigma.mean()), "max": float(sigma.max())} if good.any() else {},
        "modulus_pa": found.modulus,
        "modulus_sigma_pa": found.modulus_sigma,
        "unknowns": {name: list(value) for name, value in found.unknowns.items()},
        "undetermined": undetermined(found),
        "rests_on_priors": list(found.undetermined),
        "fit": None if found.fit is None else {"p": found.fit.p, "words": found.fit.words},
        "faults": faults(found),
    }


def reasons(found: Calibration) -> list[tuple[str, int]]:
    """Why taxels have no estimate, and how many for each reason, the most frequent first."""
    lost = ~np.isfinite(found.positions).all(axis=1)
    return Counter(map(str, np.asarray(found.reasons)[lost])).most_common()


def faults(found: Calibration) -> dict[str, str]:
    """What is wrong with taxels, by id."""
    if found.faults is None:
        return {}
    return {str(k): f for k, f in zip(found.ids, found.faults, strict=True) if f}


def certainty(found: Calibration) -> str:
    """How certain E* is, behind its number in kPa."""
    if found.modulus_sigma is None:
        return ", given"
    return f" +- {found.modulus_sigma / 1e3:.2g}"


def summary(found: Calibration, metrics: dict[str, Any], folder: Path) -> str:
    """What a person wants to read."""
    lines = [
        f"{metrics['determined']} of {metrics['taxels']} taxels determined from "
        f"{metrics['readings']} readings in {metrics['contacts']} contacts"
    ]
    if metrics["sigma_mm"]:
        spread = metrics["sigma_mm"]
        lines.append(f"  sigma            mean {spread['mean']:.4g} mm, max {spread['max']:.4g}")
    if found.modulus is not None:
        lines.append(f"  E*               {found.modulus / 1e3:.4g} kPa{certainty(found)}")
    if "gain" in found.taxel_unknowns:
        gains = found.taxel_unknowns["gain"][:, 0]
        lines.append(f"  gains            {100 * np.nanstd(gains):.2g} % apart (1 sigma)")
    if found.fit is not None:
        lines.append(f"  test of fit      {found.fit.words}")
    lines.append(f"  not determined   {metrics['undetermined']}")
    lines += [f"  left out         {n} taxels: {why}" for why, n in reasons(found)]
    named = list(metrics["faults"].items())
    lines += [f"  taxel {k:>6}     {words}" for k, words in named[:8]]
    if len(named) > 8:
        lines.append(f"  and {len(named) - 8} more: metrics.json")
    return "\n".join([*lines, f"  report           {folder / 'report.html'}"])
