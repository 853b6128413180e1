"""The commands: one thin module per verb, each with `main(argv=None) -> int`; common and files hold what they share."""
