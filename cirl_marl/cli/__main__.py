"""``python -m cirl_marl.cli``."""

from cirl_marl.cli import main

if __name__ == "__main__":
    main()
