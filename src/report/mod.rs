//! What a person judges a measurement or what was learned by: strings, to be written by the caller.
//!
//! Beside the data's way, after `reconstruct` and `correct`. [`html`] is one page that opens anywhere, also offline: the table, the points
//! in three [`views`] and on the [`unrolled`] surface, coloured by their deviation, and the [`histogram`] of the
//! deviations. [`spine_csv`] is the centre line for other programs. [`springback_svg`] is what is known of a key. The pieces that pictures are made of are in [`svg`].

mod colour;
mod histogram;
mod legend;
mod page;
mod spine_csv;
mod springback;
mod surface;
pub mod svg;
mod unrolled;
mod views;

pub use colour::{Scale, tint};
pub use page::{About, html};
pub use spine_csv::spine_csv;
pub use springback::springback_svg;
