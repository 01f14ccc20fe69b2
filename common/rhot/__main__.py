"""`python -m rhot` is the same as `rhot`."""

from rhot.cli import main

if __name__ == "__main__":
    main()
