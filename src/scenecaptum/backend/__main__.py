"""``python -m scenecaptum.backend`` prints the diagnosis."""

from . import main

raise SystemExit(main())
