"""``python -m torchrl_etdmpc.commands``, where no console script is on the path."""

from torchrl_etdmpc.commands import main

main()
