"""numba's kernels, compiled for CPUs that are not here: LLVM makes a Mac's or a server's assembly of each of them."""

import json
import os
import subprocess
import sys

import pytest
from support.running import REPOSITORY

from nerf_lightning.nerf.kernels import backends

CPUS = {"apple-m1": "aarch64-apple-darwin", "neoverse-n1": "aarch64-linux-gnu"}
BY_HAND = ("mlp.cpu", "hash_grid.cpu", "table_adam.cpu")
"""Those that choose instructions themselves."""
# In a process of its own: as for a CPU of which nothing is known, with an empty cache, as a kept kernel has no code. It
# is taken before LLVM makes instructions of it, which replaces some operations by those of this machine.
COMPILE = r"""
import json, re, sys
import llvmlite.binding as llvm
from numba.core.codegen import CPUCodeLibrary
from nerf_lightning.nerf.kernels import backends

codes, finish = [], CPUCodeLibrary._finalize_final_module

def keep(library):
    before = library._final_module.clone()
    finish(library)
    library._final_module = before  # what others are linked with
    codes.append((library.name, str(before)))

CPUCodeLibrary._finalize_final_module = keep
cpus = json.loads(sys.argv[1])
llvm.initialize_all_targets()
llvm.initialize_all_asmprinters()
machines = {cpu: llvm.Target.from_triple(triple).create_target_machine(cpu) for cpu, triple in cpus.items()}
for module in sys.argv[2:]:
    codes.clear()
    backends.backend(f"{backends.KERNELS}.{module}")
    for name, code in codes:
        foreign = re.findall(r'llvm[.]x86[.]\w+|\basm .*|"target-cpu".*', code)
        for cpu, machine in machines.items():
            there = llvm.parse_assembly(code)
            there.triple, there.data_layout = cpus[cpu], str(machine.target_data)
            print(json.dumps([module, name, cpu, machine.emit_assembly(there).count("\tret\n"), foreign]))
"""


@pytest.mark.parametrize(
    "modules",
    [
        pytest.param(BY_HAND, marks=pytest.mark.minutes, id="by hand"),
        pytest.param([each for each in backends.CPU_BACKENDS if each not in BY_HAND], marks=pytest.mark.exhaustive,
                     id="by the compiler"),
    ],
)  # fmt: skip
def test_every_kernel_becomes_assembly_of_other_cpus_and_names_no_instruction_of_intels(modules, tmp_path):
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_DISABLE_INTEL_SVML": "1"}
    done = subprocess.run(
        [sys.executable, "-c", COMPILE, json.dumps(CPUS), *modules], cwd=REPOSITORY, capture_output=True,
        text=True, env=os.environ | generic | {"NUMBA_CACHE_DIR": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    made = [json.loads(line) for line in done.stdout.splitlines()]
    assert {(name, cpu) for name, _, cpu, _, _ in made} == {(name, cpu) for name in modules for cpu in CPUS}
    assert [each for each in made if each[-1]] == []
    assert min(functions for *_, functions, _ in made) > 0
