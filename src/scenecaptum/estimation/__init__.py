"""Statistics of estimates: their errors, from the values themselves."""

from ._resampling import delete_one_jackknife as delete_one_jackknife
