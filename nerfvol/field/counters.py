"""Random numbers that depend on counters alone, such as (seed, step): the same however often a run was interrupted."""


def mixed(*counters: int) -> int:
    """64 bits of the counters, mixed by splitmix64 (Steele, Lea and Flood 2014), so that neighbouring steps are unrelated."""
    state = 0
    for counter in counters:
        state = (state + counter * 0xD1342543DE82EF95 + 0x9E3779B97F4A7C15) % 2**64
        state = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 % 2**64
        state = (state ^ state >> 27) * 0x94D049BB133111EB % 2**64
        state ^= state >> 31
    return state
