"""Reads a model file in a process of its own, so that the running server neither unpacks nor checks one.

    python -m palpate_server.session.model_process FILE STIFFNESS_FACTOR DESCRIPTOR

A large or damaged file costs the server's process neither the interpreter's lock nor memory beyond the model. The child puts
the checked model into an anonymous file (a memfd) that it inherits: a pickle without its arrays, then the arrays. The
server maps that file and copies nothing. Only our own child's pickle is read; of the model file nothing is unpickled.
"""

from __future__ import annotations

import mmap
import os
import pickle
import resource
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

from palpate.model_file import ModelFileError, SurfaceModel, load_model, stiffened
from palpate_server.coupling.models import Model

_TIMEOUT_S = 60.0
_POLL_S = 0.01
_MOST_MEMORY_BYTES = 4 * 2**30
_NICE = 5  # after the loop and its threads; at 10, two busy loops leave a load too little time to be answered
_EXIT_REFUSED = 2
_ALIGNMENT = 64
_HEAD = struct.Struct("<QQ")  # bytes of the pickle, number of arrays; then the bytes of each array as <Q


def load_model_elsewhere(path: Path, stopping: threading.Event, stiffness_factor: float = 1.0) -> Model:
    """The model in a file, as `load_model` gives it, with its moduli times a factor; its arrays are read-only.

    Raises ModelFileError for what is no model, takes too long, has no modulus to change, or when `stopping` is set meanwhile;
    OSError.
    """
    descriptor = os.memfd_create("palpate-model")
    try:
        what = (str(path), repr(stiffness_factor), str(descriptor))
        process = subprocess.Popen(
            [sys.executable, "-m", "palpate_server.session.model_process", *what],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            pass_fds=(descriptor,),
            start_new_session=True,  # Ctrl-C is for the server
        )
        give_up = time.monotonic() + _TIMEOUT_S
        try:
            while process.poll() is None:
                if stopping.wait(_POLL_S) or time.monotonic() > give_up:
                    raise ModelFileError(f"{path}: could not be read in {_TIMEOUT_S:g} s")
        finally:
            process.kill()
            _, errors = process.communicate()
        if process.returncode == _EXIT_REFUSED:
            raise ModelFileError(errors.decode(errors="replace").strip())
        if process.returncode != 0:
            raise ModelFileError(f"{path}: reading it ended with code {process.returncode}")
        return _receive(descriptor)
    finally:
        os.close(descriptor)


def _receive(descriptor: int) -> Model:
    view = memoryview(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ))
    n_pickle, n_arrays = _HEAD.unpack_from(view)
    sizes = struct.unpack_from(f"<{n_arrays}Q", view, _HEAD.size)
    place = _HEAD.size + 8 * n_arrays
    pickled = view[place : place + n_pickle]
    place += n_pickle
    arrays = []
    for size in sizes:
        place += -place % _ALIGNMENT
        arrays.append(view[place : place + size])
        place += size
    model: Model = pickle.loads(pickled, buffers=arrays)
    return model


def _send(model: Model, descriptor: int) -> None:
    buffers: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(model, protocol=5, buffer_callback=buffers.append)
    arrays = [buffer.raw() for buffer in buffers]
    sizes = [array.nbytes for array in arrays]
    with open(descriptor, "wb", closefd=False) as file:
        file.write(_HEAD.pack(len(pickled), len(sizes)) + struct.pack(f"<{len(sizes)}Q", *sizes) + pickled)
        for array in arrays:
            file.write(bytes(-file.tell() % _ALIGNMENT))
            file.write(array)


def _with_stiffness(model: Model, factor: float, path: Path) -> Model:
    """Raises ModelFileError for a patch model and a factor that is not 1."""
    if factor == 1.0:
        return model
    if not isinstance(model, SurfaceModel):
        raise ModelFileError(
            f"{path}: a model of patches has no modulus: stiffness_factor is {factor:g}, expected 1"
        )
    return stiffened(model, factor)


def main() -> int:
    path, factor, descriptor = Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
    os.nice(_NICE)
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY_BYTES, _MOST_MEMORY_BYTES))
    try:
        _send(_with_stiffness(load_model(path), factor, path), descriptor)
    except (OSError, RuntimeError, ModelFileError) as error:
        print(error, file=sys.stderr)
        return _EXIT_REFUSED
    except MemoryError:
        print(f"{path}: does not fit into {_MOST_MEMORY_BYTES / 2**30:g} GiB", file=sys.stderr)
        return _EXIT_REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
