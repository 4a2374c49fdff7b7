"""The command line of xfemnav, installed as the package xfemnav_cli."""
