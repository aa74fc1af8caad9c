"""`meshskin calibrate RECORDING --out DIR`: calibrate a skin from a recorded log.

RECORDING is the common prefix of the names of a recording's files, or a folder with contacts.csv
(columns time, px, py, pz, force; also qw, qx, qy, qz if the indenter's offset is unknown; one row
per frame in contact, contact points in the body frame) and readings.csv (columns time, taxel,
pressure; for raw readings, with --raw, reading or count in place of pressure). Columns are in SI
units or name their unit: px_mm, pressure_kpa, time_ms.

Exit code 0: the verdict is PASS or DOUBT; 1: it is FAIL, the results are written and must not be
used; 2: bad input.
"""

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

SCENE_OPTIONS = (
    "body", *body_options.NAMES, "indenter_radius_mm", "young_kpa", "poisson", "thickness_mm",
)  # fmt: skip
"""Options whose values come from the scene when --scene is given."""
PRESSURE_OPTIONS = ("noise_kpa", "threshold_kpa", "saturation_kpa")
"""Options that state pressures."""
NOMINAL_YOUNG_KPA = 200.0
"""Young's modulus at which the estimate from raw readings starts where none is given: that of soft
silicone rubber. It sets the first size of the patch, which is estimated."""
FAILED = 1
"""Exit code where the verdict is FAIL."""
NUMBERS = {
    "--indenter-radius-mm": "radius of the indenter",
    "--young-kpa": "approximate Young's modulus of the skin",
    "--poisson": "Poisson's ratio of the skin (default 0.49)",
    "--thickness-mm": "thickness of the soft layer on a rigid core",
    "--disc-radius-mm": "radius of a taxel (default 2)",
    "--noise-kpa": "standard deviation of the noise of a reading",
    "--threshold-kpa": "pressures up to this value are not recorded",
    "--saturation-kpa": "upper end of the sensor's range",
}
"""Options that are numbers."""
SHOWN = 8
"""Taxels with faults that the summary lists; metrics.json has all."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
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
    for name, words in NUMBERS.items():
        unit = name.rpartition("-")[2].upper()
        known.add_argument(name, type=float, metavar=unit, help=words)
    known.add_argument(
        "--raw",
        action="store_true",
        help="readings are counts or volts of any scale and sign; the response is learned, and "
        f"--young-kpa only sets its start (default {NOMINAL_YOUNG_KPA:g})",
    )
    known.add_argument(
        "--contact",
        help="contact model: hertz, elliptic, layered, learned or auto (default: the first that is "
        "valid, or learned where the readings contradict it)",
    )
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
        "--cross-validate", type=int, metavar="FOLDS", help="hold out contacts in FOLDS folds and "
        "localise them by the skin calibrated on the others: one more calibration per fold",
    )  # fmt: skip
    parser.add_argument(
        "--export", type=Path, metavar="FILE", help="write the skin map to FILE, by suffix: .txt "
        "(iCub), .csv, .urdf, .xml (MuJoCo), .npz, .yaml (ROS), .ply or .glb",
    )  # fmt: skip
    parser.add_argument(
        "--export-format", metavar="FORMAT", help="whatever the suffix: urdf_tactile"
    )


def command(options: argparse.Namespace) -> int:
    """Calibrate, write the results, and print the summary."""
    from ..core.atomic_io import check_folder, check_writable, write_json
    from ..core.provenance import provenance
    from ..estimation.calibrate import calibrate
    from ..estimation.uncertainty.verdict import FAIL
    from ..pipeline import remove_results
    from ..recording.recording import Recording
    from ..skin.files import check_format

    if options.export is not None:
        check_format(options.export_format or options.export.suffix.lstrip("."))
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
        export(found, belief, options.export, options.export_format)
    metrics = assess(found, recording)
    validation = None
    if options.cross_validate is not None:
        validation = found.cross_validate(recording, options.cross_validate, belief)
        metrics["cross_validation"] = validation.metrics()
    found.report(
        options.out / "report.html",
        body=belief.body,
        recording=recording,
        metrics=metrics,
        seconds=found.seconds,
        provenance=provenance(recording=str(options.recording)),
        validation=validation,
    )
    metrics["seconds"] = {**found.seconds, "all": perf_counter() - clock}
    write_json(options.out / "metrics.json", metrics)
    print(summary(found, metrics, options.out))
    return FAILED if found.verdict is not None and found.verdict.level == FAIL else 0


def belief_of(options: argparse.Namespace, recording: Recording) -> Belief:
    """The belief that the options describe. Raises ConfigError if they are incomplete."""
    from ..scene.belief import RAW
    from ..skin import slots

    if options.raw:
        _check_raw(options)
    belief = _by_scene(options) if options.scene else _by_options(options)
    kilo = {
        "noise_sigma": options.noise_kpa,
        "threshold": options.threshold_kpa,
        "saturation": options.saturation_kpa,
    }
    changes: dict[str, Any] = {k: 1e3 * v for k, v in kilo.items() if v is not None}
    if options.raw:  # a scene's noise, threshold and saturation are pressures
        changes = {"readings": RAW, "noise_sigma": None, "threshold": 0.0, "saturation": None}
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


def _check_raw(options: argparse.Namespace) -> None:
    """Refuse options that mean nothing for raw readings."""
    from ..contact import AUTO, LEARNED

    given = [name for name in PRESSURE_OPTIONS if getattr(options, name) is not None]
    given += ["contact"] if options.contact not in (None, AUTO, LEARNED) else []
    given += ["modules"] if options.modules else []
    if given:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ConfigError(
            "raw readings have no unit, and their response is learned for independent taxels",
            value=f"{names} together with --raw",
            remedy="remove it: noise, threshold and saturation follow from the readings",
        )


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

    young = NOMINAL_YOUNG_KPA if options.raw and options.young_kpa is None else options.young_kpa
    needed = {
        "--body": options.body,
        "--indenter-radius-mm": options.indenter_radius_mm,
        "--young-kpa": young,
    }
    missing = [name for name, value in needed.items() if value is None]
    if missing:
        raise ConfigError(
            f"required options are missing: {', '.join(missing)}",
            remedy="give --scene, or all of --body, --indenter-radius-mm and --young-kpa (which "
            "--raw does not need)",
        )
    poisson = 0.49 if options.poisson is None else options.poisson
    thickness = None if options.thickness_mm is None else 1e-3 * options.thickness_mm
    return Belief(
        body=body_options.load(options.body, options),
        indenter=Indenter.sphere(1e-3 * options.indenter_radius_mm),
        material=Material(1e3 * young, poisson, thickness),
        taxel_ids=np.empty(0, dtype=int),
        contact=AUTO,
    )


def export(found: Calibration, belief: Belief, path: Path, kind: str | None) -> None:
    """Write the skin map of the determined taxels as `kind` (None: by suffix). Raises SkinError."""
    from ..skin.skin import Skin

    good = np.isfinite(found.poses).all(axis=(1, 2))
    if not good.any():
        raise CalibrationError("no taxel is determined, so there is no skin map to export")
    Skin(found.poses[good], found.ids[good], belief.disc_radius).save(path, kind)


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
        "response": None if found.response is None else found.response.metrics(),
        "unknowns": {name: list(value) for name, value in found.unknowns.items()},
        "undetermined": undetermined(found),
        "rests_on_priors": list(found.undetermined),
        "fit": None if found.fit is None else {"p": found.fit.p, "words": found.fit.words},
        "faults": faults(found),
    }


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


def response_lines(found: Calibration) -> list[str]:
    """Lines that say what was learned of the response; none where the contact model's was used."""
    if found.response is None:
        return []
    words = found.response.describe()
    return ["  response         learned with the taxels", *(f"    {text}" for text in words)]


def summary(found: Calibration, metrics: dict[str, Any], folder: Path) -> str:
    """The text that the command prints."""
    from ..estimation.cross_validation import held_out_in_words

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
        if name not in ("modulus", "contact_scatter", "force_scatter"):
            lines.append(f"  {name:<16} {value:.4g} +- {sigma:.2g} {unit}".rstrip())
    lines += response_lines(found)
    if "gain" in found.taxel_unknowns:
        gains = found.taxel_unknowns["gain"][:, 0]
        lines.append(f"  gains            {100 * np.nanstd(gains):.2g} % apart (1 sigma)")
    if found.fit is not None:
        lines.append(f"  test of fit      {found.fit.words}")
    if "cross_validation" in metrics:
        lines.append(f"  held out         {held_out_in_words(metrics['cross_validation'])}")
    lines.append(f"  not determined   {metrics['undetermined']}")
    lost = Counter(map(str, np.asarray(found.reasons)[~np.isfinite(found.positions).all(axis=1)]))
    lines += [f"  left out         {n} taxels: {why}" for why, n in lost.most_common()]
    named = list(metrics["faults"].items())
    lines += [f"  taxel {k:>6}     {words}" for k, words in named[:SHOWN]]
    if len(named) > SHOWN:
        lines.append(f"  and {len(named) - SHOWN} more: metrics.json")
    return "\n".join([*lines, f"  report           {folder / 'report.html'}"])
