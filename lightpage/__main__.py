"""`python -m lightpage`: the command line."""

from lightpage.cli.main import main

if __name__ == "__main__":
    main()
