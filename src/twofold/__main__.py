"""`python -m twofold` is the `twofold` command; `torchrun --nproc-per-node 2 -m twofold train ...` runs it in teams."""

from twofold.cli.main import main

main()
