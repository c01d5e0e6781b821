"""The one exception that means "what the user gave cannot be used"."""


class InputError(ValueError):
    """Bad input. The message is one sentence that names the argument or file, what was expected and what came."""


class RenderWarning(UserWarning):
    """The picture is valid but probably not what was wanted, such as a scene without lights."""
