"""Histogram of durations for the loop: fixed size, no allocation, quantiles within one bucket (9 %)."""

_SUB_BUCKETS = 8
_OCTAVES = 40


class Histogram:
    """Counts of durations in log-linear buckets: 8 an octave, from 1 us up."""

    def __init__(self) -> None:
        self._counts = [0] * (_SUB_BUCKETS * _OCTAVES)
        self.total = 0
        self.max_us = 0.0

    def add(self, duration_ns: int) -> None:
        """Count one duration; negative ones count as zero."""
        us = duration_ns // 1000
        if us < _SUB_BUCKETS:
            bucket = max(us, 0)
        else:
            shift = us.bit_length() - 4
            bucket = (shift << 3) + (us >> shift)
        self._counts[min(bucket, len(self._counts) - 1)] += 1
        self.total += 1
        self.max_us = max(self.max_us, duration_ns * 1e-3)

    def quantile_us(self, share: float) -> float:
        """Return the duration below which `share` of the counts lie (upper edge of its bucket); 0 where empty."""
        if self.total == 0:
            return 0.0
        wanted = share * self.total
        seen = 0
        for bucket, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return min(self._upper_edge_us(bucket), self.max_us)
        return self.max_us

    def clear(self) -> None:
        """Forget all counts."""
        for bucket in range(len(self._counts)):
            self._counts[bucket] = 0
        self.total = 0
        self.max_us = 0.0

    @staticmethod
    def _upper_edge_us(bucket: int) -> float:
        if bucket < 2 * _SUB_BUCKETS:
            return float(bucket + 1)
        shift = (bucket >> 3) - 1
        return float(((bucket & 7) + 8 + 1) << shift)
