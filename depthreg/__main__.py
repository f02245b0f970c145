"""`python -m depthreg` is `depthreg`."""

import sys

from depthreg.cli import main

sys.exit(main())
