"""The table of commands."""

from typing import Annotated

import tyro

from jaxreg.cli.average import Average
from jaxreg.cli.demo import Demo
from jaxreg.cli.info import Info
from jaxreg.cli.multiview import Multiview
from jaxreg.cli.register import Register


COMMANDS = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Register, tyro.conf.subcommand("register")]
    | Annotated[Multiview, tyro.conf.subcommand("multiview")]
    | Annotated[Average, tyro.conf.subcommand("average")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)
