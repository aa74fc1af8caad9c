"""SciPy's BLAS for IPOPT's linear solver.

On Linux CasADi's wheel brings an OpenBLAS built for processors of 2006, without AVX; the one that
SciPy brings is made for all, and factorises up to twice as fast. A library found under the name of
CasADi's is loaded first, so that the dynamic linker gives it to MUMPS: it passes every call on to
the functions that SciPy offers to other compiled code (scipy.linalg.cython_blas, cython_lapack).
Nothing else in the process sees it. It is done only where `MESHSKIN_BLAS=scipy` asks for it, since
it leans on how both wheels are built; and CasADi's own stays in place where something is not as
expected: no compiler, another platform, IPOPT loaded before.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import os
import re
import sys
from pathlib import Path

import casadi as ca

from meshskin import compiled

THEIRS = "libcasadi-tp-openblas.so.0"
CLIENTS = ("libcoinmumps.so.3", "libipopt.so.3")
MODULES = ("scipy.linalg.cython_blas", "scipy.linalg.cython_lapack")
TAKEN = re.compile("d|idamax$")
"""Functions that are passed on: those of real numbers in double precision."""
MISSING = Path(__file__).with_name("blas.c")
"""Source of what SciPy does not offer."""
SIGNATURE = re.compile(r"(\w+) \(([^()]*)\)")


@functools.cache
def use_scipys_blas() -> bool:
    """Whether IPOPT's linear solver now uses SciPy's BLAS; to be called before IPOPT is loaded."""
    folder = Path(ca.__file__).parent
    if os.environ.get("MESHSKIN_BLAS") != "scipy" or not sys.platform.startswith("linux"):
        return False
    if not all((folder / name).exists() for name in (THEIRS, *CLIENTS)):
        return False
    found = _functions()
    text = "\n".join([*(_passed_on(*f) for f in found), MISSING.read_text(), _table(found)])
    shim = compiled.library("blas", text, (*compiled.FLAGS, "-w", f"-Wl,-soname,{THEIRS}"))
    if shim is None:
        return False
    theirs = ctypes.CDLL(str(folder / THEIRS))
    addresses = [address for *_, address in found]
    addresses.append(ctypes.cast(theirs.ilaenv_, ctypes.c_void_p).value or 0)
    table = (ctypes.c_void_p * len(addresses)).in_dll(shim, "table")
    for k, address in enumerate(addresses):
        ctypes.c_void_p.from_address(table[k] or 0).value = address
    return _clients_load(folder, shim)


def _functions() -> list[tuple[str, str, int, int]]:
    """(name, type returned, number of arguments, address) of SciPy's functions."""
    pointer, name = ctypes.pythonapi.PyCapsule_GetPointer, ctypes.pythonapi.PyCapsule_GetName
    pointer.restype, pointer.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
    name.restype, name.argtypes = ctypes.c_char_p, (ctypes.py_object,)
    found = []
    for module in MODULES:
        capsules = importlib.import_module(module).__pyx_capi__
        for key, capsule in sorted(capsules.items()):
            signature = SIGNATURE.fullmatch(name(capsule).decode())
            if TAKEN.match(key) and signature:  # those that take functions have no such signature
                returned = signature[1] if signature[1] in ("void", "int") else "double"
                address = pointer(capsule, name(capsule))
                found.append((key, returned, signature[2].count(",") + 1, address))
    return found


def _passed_on(name: str, returned: str, count: int, address: int) -> str:
    """C code of the Fortran function `name`_; the lengths of strings are left out."""
    declared = ", ".join(f"void *a{k}" for k in range(count))
    given = ", ".join(f"a{k}" for k in range(count))
    back = "" if returned == "void" else "return "
    return (
        f"static {returned} (*its_{name})({declared});\n"
        f"{returned} {name}_({declared}) {{ {back}its_{name}({given}); }}"
    )


def _table(found: list[tuple[str, str, int, int]]) -> str:
    """C code of the array with the addresses of all pointers, that of ilaenv last."""
    names = [*(name for name, *_ in found), "ilaenv"]
    return f"void *table[] = {{{', '.join(f'&its_{name}' for name in names)}}};"


def _clients_load(folder: Path, shim: ctypes.CDLL) -> bool:
    """Load IPOPT with every symbol bound at once; where one is missing, the shim goes again."""
    try:
        for name in CLIENTS:
            ctypes.CDLL(str(folder / name), os.RTLD_NOW)
    except OSError:
        close = ctypes.CDLL(None).dlclose
        close.argtypes = (ctypes.c_void_p,)
        close(shim._handle)
        return False
    return True
