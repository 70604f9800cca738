//! Reserving memory for lists that grow while a search goes on.

/// Once `items` has room for only a few more, reserves room for one and a half times `growth` times as many. A vector that grows by itself
/// copies its items again and again; memory that is reserved and not filled costs nothing. Does nothing if the reservation fails.
pub(crate) fn make_room<T>(items: &mut Vec<T>, growth: f64) {
    // Without it, they grow as they come.
    let _ = items.try_reserve_exact(room_to_make(items.len(), items.capacity(), growth));
}

/// For how many more than `n_items` [`make_room`] reserves room; 0 if there is enough.
pub(crate) fn room_to_make(n_items: usize, capacity: usize, growth: f64) -> usize {
    const FEW: usize = 1 << 12;
    /// As not all items become more at the same pace.
    const MORE: f64 = 1.5;
    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "about")]
    let times = |factor: f64| (n_items as f64 * factor) as usize;
    if capacity - n_items >= FEW || capacity >= times(growth) {
        return 0;
    }
    (times(growth * MORE) - n_items).max(FEW)
}
