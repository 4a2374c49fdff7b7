"""`python -m xfemnav` is the command `xfemnav`."""

from xfemnav_cli.main import main

if __name__ == "__main__":
    main()
