"""The commands of `rtest`, one module each: HELP, `add_arguments` and `run`.

What a command needs beyond the standard library it imports when it runs, so that `rtest info`
needs no ROS and `rtest --help` answers at once.
"""
