"""What tests of the commands share."""

from functools import partial

from mujoban_core.program import exit_status

ALL_ORACLES = ["--oracle", "estimator,termination,planner,controller"]
BUT_PLANNER = ["--oracle", "estimator,termination,controller"]
UNSOLVABLE = """\
#####
#@  #
#  $#
#.  #
#####
"""


def run(command, *arguments):
    return exit_status("command", partial(command.main, [str(a) for a in arguments]))
