"""The table of commands."""

from typing import Annotated

import tyro

from jaxreg.app.cli.average import Average
from jaxreg.app.cli.demo import Demo
from jaxreg.app.cli.info import Info
from jaxreg.app.cli.multiview import Multiview
from jaxreg.app.cli.register import Register


COMMANDS = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Register, tyro.conf.subcommand("register")]
    | Annotated[Multiview, tyro.conf.subcommand("multiview")]
    | Annotated[Average, tyro.conf.subcommand("average")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)
