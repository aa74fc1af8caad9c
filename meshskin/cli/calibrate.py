"""`meshskin calibrate RECORDING --out DIR`: calibrate a skin from a recorded log of contacts."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import CalibrationError, ConfigError
from . import body_options

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration
    from ..recording.recording import Recording
    from ..scene.belief import Belief

DESCRIPTION = """
RECORDING is the common prefix of the names of a recording's files, or a folder with contacts.csv
(columns time, px, py, pz, force; also qw, qx, qy, qz if the indenter's offset is unknown; one row
per frame in contact, contact points in the body frame) and readings.csv (columns time, taxel,
pressure). Columns are in SI units or name their unit: px_mm, pressure_kpa, time_ms.
"""

SCENE_OPTIONS = (
    "body", *body_options.NAMES, "indenter_radius_mm", "young_kpa", "poisson", "thickness_mm",
)  # fmt: skip
"""Options whose values come from the scene when --scene is given."""
SHOWN = 8
"""Taxels with faults that the summary lists; metrics.json has all."""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "calibrate", help="calibrate a skin from a recorded log", description=DESCRIPTION
    )
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="recorded log, see above")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    parser.add_argument(
        "--scene", help="name or file of a scene that gives body, indenter and material"
    )
    known = parser.add_argument_group("known properties of the robot")
    known.add_argument(
        "--body",
        type=Path,
        metavar="MESH",
        help=f"mesh of the body that the skin covers: {body_options.HELP}",
    )
    body_options.add(known)
    known.add_argument(
        "--indenter-radius-mm", type=float, metavar="R", help="radius of the indenter"
    )
    known.add_argument(
        "--young-kpa", type=float, metavar="E", help="approximate Young's modulus of the skin"
    )
    known.add_argument("--poisson", type=float, help="Poisson's ratio of the skin (default 0.49)")
    known.add_argument(
        "--thickness-mm", type=float, help="thickness of the soft layer on a rigid core"
    )
    known.add_argument(
        "--contact",
        help="contact model: hertz, elliptic, layered or auto (default: the first that is valid)",
    )
    known.add_argument("--disc-radius-mm", type=float, help="radius of a taxel (default 2)")
    known.add_argument(
        "--noise-kpa", type=float, help="standard deviation of the noise of a reading"
    )
    known.add_argument(
        "--threshold-kpa", type=float, help="pressures up to this value are not recorded"
    )
    known.add_argument("--saturation-kpa", type=float, help="upper end of the sensor's range")
    known.add_argument(
        "--taxels", type=Path, metavar="FILE", help="skin file that lists the ids of all taxels"
    )
    known.add_argument(
        "--modules",
        action="store_true",
        help="taxels lie on rigid triangular modules, id = 12 module + slot",
    )
    known.add_argument(
        "--unknown", nargs="*", metavar="NAME", help="parameters estimated with the taxels: "
        "modulus (default), gain, offset, force_scale, force_offset, indenter_offset, body_offset",
    )  # fmt: skip
    parser.add_argument(
        "--method", default="joint", help="estimator: joint (default), posegraph, ..."
    )
    parser.add_argument(
        "--iterations", type=int, metavar="N", help="iteration limit of the joint estimate"
    )
    parser.add_argument(
        "--export", type=Path, metavar="FILE", help="write the skin map to FILE; its suffix gives "
        "the format: .txt (iCub position file), .csv, .urdf, .ply or .glb",
    )  # fmt: skip
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Calibrate, write the results, and print the summary."""
    from ..core.atomic_io import check_folder, check_writable, write_json
    from ..core.provenance import provenance
    from ..estimation.calibrate import calibrate
    from ..pipeline import remove_results
    from ..recording.recording import Recording
    from ..skin.files import check_format

    if options.export is not None:
        check_format(options.export.suffix.lstrip("."))
    clock = perf_counter()
    recording = Recording.load(options.recording)
    belief = belief_of(options, recording)
    check_folder(options.out)
    if options.export is not None:
        check_writable(options.export)
    limit = {} if options.iterations is None else {"iterations": options.iterations}
    found = calibrate(recording, belief, method=options.method, **limit)
    remove_results(options.out)
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


def belief_of(options: argparse.Namespace, recording: Recording) -> Belief:
    """The belief that the options describe. Raises ConfigError if they are incomplete."""
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
    """The belief of the scene named by --scene."""
    from ..scene.scene import Scene

    given = [name for name in SCENE_OPTIONS if getattr(options, name) is not None]
    if given:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ConfigError(
            "--scene gives body, indenter and material", value=f"{names} together with --scene",
            remedy="remove either --scene or the other options",
        )  # fmt: skip
    return Scene.load(options.scene).belief()


def _by_options(options: argparse.Namespace) -> Belief:
    """The belief built from --body, --indenter-radius-mm, --young-kpa and so on."""
    from ..contact import AUTO
    from ..contact.indenter import Indenter
    from ..contact.material import Material
    from ..scene.belief import Belief

    needed = {
        "--body": options.body,
        "--indenter-radius-mm": options.indenter_radius_mm,
        "--young-kpa": options.young_kpa,
    }
    missing = [name for name, value in needed.items() if value is None]
    if missing:
        raise ConfigError(
            f"required options are missing: {', '.join(missing)}",
            remedy="give --scene, or all of --body, --indenter-radius-mm and --young-kpa",
        )
    poisson = 0.49 if options.poisson is None else options.poisson
    thickness = None if options.thickness_mm is None else 1e-3 * options.thickness_mm
    return Belief(
        body=body_options.load(options.body, options),
        indenter=Indenter.sphere(1e-3 * options.indenter_radius_mm),
        material=Material(1e3 * options.young_kpa, poisson, thickness),
        taxel_ids=np.empty(0, dtype=int),
        contact=AUTO,
    )


def export(found: Calibration, belief: Belief, path: Path) -> None:
    """Write the skin map of the determined taxels. Raises SkinError, OutputError."""
    from ..skin.skin import Skin

    good = np.isfinite(found.poses).all(axis=(1, 2))
    if not good.any():
        raise CalibrationError("no taxel is determined, so there is no skin map to export")
    Skin(found.poses[good], found.ids[good], belief.disc_radius).save(path)


def assess(found: Calibration, recording: Recording) -> dict[str, Any]:
    """The content of metrics.json: quantities that need no ground truth."""
    from ..estimation.uncertainty.metrics import undetermined

    good = found.observed[:, :2].all(axis=1)
    sigma = 1e3 * found.position_sigma[good]
    return {
        "verdict": None if found.verdict is None else found.verdict.metrics(),
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
    """Reasons why taxels have no estimate with their counts, the most frequent first."""
    lost = ~np.isfinite(found.positions).all(axis=1)
    return Counter(map(str, np.asarray(found.reasons)[lost])).most_common()


def faults(found: Calibration) -> dict[str, str]:
    """Faults of taxels by taxel id."""
    if found.faults is None:
        return {}
    return {str(k): f for k, f in zip(found.ids, found.faults, strict=True) if f}


def certainty(found: Calibration) -> str:
    """Text that follows the value of E* in kPa: its standard deviation, or that it was given."""
    if found.modulus_sigma is None:
        return ", given"
    return f" +- {found.modulus_sigma / 1e3:.2g}"


def summary(found: Calibration, metrics: dict[str, Any], folder: Path) -> str:
    """The text that the command prints."""
    lines = [
        *([str(found.verdict)] if found.verdict is not None else []),
        f"{metrics['determined']} of {metrics['taxels']} taxels determined from "
        f"{metrics['readings']} readings in {metrics['contacts']} contacts",
    ]
    if metrics["sigma_mm"]:
        spread = metrics["sigma_mm"]
        lines.append(f"  sigma            mean {spread['mean']:.4g} mm, max {spread['max']:.4g}")
    if found.modulus is not None:
        lines.append(f"  E*               {found.modulus / 1e3:.4g} kPa{certainty(found)}")
    for name, (value, sigma, unit) in found.parameter_values.items():
        if name != "modulus":
            lines.append(f"  {name:<16} {value:.4g} +- {sigma:.2g} {unit}".rstrip())
    if "gain" in found.taxel_unknowns:
        gains = found.taxel_unknowns["gain"][:, 0]
        lines.append(f"  gains            {100 * np.nanstd(gains):.2g} % apart (1 sigma)")
    if found.fit is not None:
        lines.append(f"  test of fit      {found.fit.words}")
    lines.append(f"  not determined   {metrics['undetermined']}")
    lines += [f"  left out         {n} taxels: {why}" for why, n in reasons(found)]
    named = list(metrics["faults"].items())
    lines += [f"  taxel {k:>6}     {words}" for k, words in named[:SHOWN]]
    if len(named) > SHOWN:
        lines.append(f"  and {len(named) - SHOWN} more: metrics.json")
    return "\n".join([*lines, f"  report           {folder / 'report.html'}"])
