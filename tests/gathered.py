"""Keywords of a call, with those that are fields of its options gathered in `options`."""

from dataclasses import fields

import koopmpc as km


def gather(options, **keywords):
    """Return the keywords, those that are fields of this options class as one object of it."""
    own = {f.name: keywords.pop(f.name) for f in fields(options) if f.name in keywords}
    return keywords | ({"options": options(**own)} if own else {})


def of_loop(**keywords):
    """Return keywords of `km.simulate`."""
    return gather(km.loop.LoopOptions, **keywords)


def of_certificate(**keywords):
    """Return keywords of `km.certify`."""
    return gather(km.guarantees.CertifyOptions, **keywords)
