"""How the compiled kernels are loaded."""

import subprocess
import sys


def test_numba_is_loaded_without_blas_and_does_not_hide_it():
    code = (
        "import sys\n"
        "from nerf_lightning.kernels.backends import twin\n"
        "print(twin('packed_numba').__name__, 'numba.np.arraymath' in sys.modules, 'scipy.linalg' in sys.modules)\n"
        "import scipy.linalg.cython_blas as blas\n"
        "print(blas.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["nerf_lightning.kernels.packed_numba True False", "scipy.linalg.cython_blas"]
