def add_flags(parser, **defaults):
    """A flag for each name: of the default's type; a switch for False, one or more numbers for a list."""
    for name, default in defaults.items():
        kind = {"type": type(default), "default": default}
        if default is False:
            kind = {"action": "store_true"}
        elif isinstance(default, list):
            kind = {"type": int, "nargs": "+", "default": default}
        parser.add_argument("--" + name, **kind)


TRAINING = {"ip": "127.0.0.1", "port": 6009, "debug_from": -1, "test_iterations": [7], "save_iterations": [],
            "checkpoint_iterations": [], "start_checkpoint": "", "quiet": False}
RENDERING = {"iteration": -1, "skip_train": False, "skip_test": False, "quiet": False}
