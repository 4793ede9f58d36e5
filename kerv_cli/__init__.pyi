from kerv_cli.api import KervError as KervError
from kerv_cli.api import Policy as Policy
from kerv_cli.api import Study as Study
from kerv_cli.api import load_policy as load_policy
from kerv_cli.api import load_study as load_study
from kerv_cli.api import rollout as rollout
from kerv_cli.api import runs as runs
from kerv_cli.api import sweep as sweep
