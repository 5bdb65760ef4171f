"""Import Mitsuba with a differentiable variant and a working LLVM, or explain what is missing.

Dr.Jit compiles rendering kernels with LLVM (CPU) or CUDA (GPU) and loads LLVM when it is first imported. All
code that needs Mitsuba therefore calls ``activate``, which selects an LLVM library before the import.

Example
-------
>>> import scenecaptum as sc
>>> mi = sc.activate()
>>> scene = mi.load_dict(mi.cornell_box())
"""

# What users call; the other names are for the rooms above.
__all__ = ["activate"]

from ._diagnosis import Diagnosis as Diagnosis
from ._diagnosis import default_variant as default_variant
from ._diagnosis import diagnose as diagnose
from ._heap import trim_heap as trim_heap
from ._llvm import choose_llvm as choose_llvm
from ._threads import at_least_two_threads as at_least_two_threads
from ._threads import use_threads as use_threads
from ._variants import SceneOwner as SceneOwner
from ._variants import activate as activate
from ._variants import device as device
from ._variants import exclusively as exclusively
from ._variants import warn_unless_rgb as warn_unless_rgb


def main() -> int:
    """Print the diagnosis and return the exit status: 0 if scenes can be rendered, else 1."""
    diagnosis = diagnose()
    print(diagnosis)
    return 0 if diagnosis.ok else 1
