"""Run functions for studies in tests; `own` parameters say what goes wrong, and where."""

import math
import os
import signal
import sys
import time
from pathlib import Path


def plain(case):
    """Numbers that depend on the case alone."""
    x = case.own.get("x", 1.0)
    return {"y": math.sin(x * (1 + case.seed)), "twice": 2 * case.seed}


def slow(case):
    """Plain numbers, after a while; leaves a mark in the folder `marks` if one is given."""
    if marks := case.own.get("marks"):
        (Path(marks) / f"{case.key}.{os.getpid()}").touch()
    time.sleep(case.own.get("sleep", 0.05))
    return plain(case)


def busy(case):
    """Keeps a core busy for some seconds of processor time."""
    end = time.process_time() + case.own["work"]
    total = 0.0
    while time.process_time() < end:
        total += math.sqrt(total + 1)
    return plain(case)


def troubled(case):
    """What `trouble` says, in the cases whose seed is 2."""
    trouble = case.own["trouble"] if case.seed == 2 else "none"
    if mark := case.own.get("mark"):
        Path(mark).write_text(str(os.getpid()))
    if trouble == "raise":
        raise ValueError("no such\nluck")
    if trouble == "hang":
        time.sleep(3600)
    if trouble == "hang in C":
        sum(range(10**12))
    if trouble == "memory":
        hoard = []
        while True:
            hoard.append(bytearray(50_000_000))
    if trouble == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if trouble.startswith("exit"):
        os._exit(int(trouble.split()[1]))
    if trouble == "sys.exit":
        sys.exit(5)
    if trouble == "type":
        return {"y": object()}
    if trouble == "child":
        os.system("sleep 3600")
    return plain(case)


def killed_once(case):
    """Ends its process the first time that the case is tried."""
    mark = Path(case.own["marks"]) / case.key
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return plain(case)


def chatty(case):
    """Prints where frames could be, and reads where orders could be."""
    print("x" * 100_000, flush=True)
    os.system("echo child; cat")
    return plain(case)


def surroundings(case):
    """What a worker sees."""
    return {
        "threads": os.environ["OMP_NUM_THREADS"],
        "hashes": hash("meshskin"),
        "parent": os.getppid(),
    }
