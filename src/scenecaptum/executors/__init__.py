"""Executors: where work is done that is split among processes, on this machine or on a cluster.

Any ``concurrent.futures.Executor`` will do whose workers are processes: `process_pool` on this machine,
``Client.get_executor()`` of Dask, `RayExecutor`.
"""

# What users call; the other names are for the rooms above.
__all__ = ["RayExecutor", "process_pool"]

from ._kept import made as made
from ._pool import Workers as Workers
from ._pool import process_pool as process_pool
from ._ray import RayExecutor as RayExecutor
from ._spread import spread as spread
