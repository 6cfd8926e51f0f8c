"""`python -m splashbench` is the command line, for places where the script is not on the path."""

import sys

from splashbench.cli.main import main

sys.exit(main())
