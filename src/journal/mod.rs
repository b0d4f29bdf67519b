//! The record: what was measured, decided, sent and acknowledged, chained by hash.
