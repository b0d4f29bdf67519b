//! A picture's legend, row below row, and the marks of its points.

use std::fmt::{Result, Write};

use super::svg::{line, text};

/// Words that stand back.
pub(super) const QUIET: &str = "fill=\"#57606a\" font-size=\"12\"";

/// What is below each other in the legend.
pub(super) struct Legend<'a> {
    pub svg: &'a mut String,
    pub x: f64,
    /// Where the next row goes.
    pub y: f64,
}

impl Legend<'_> {
    pub fn heading(&mut self, words: &str) -> Result {
        self.y += 10.0;
        text(self.svg, self.x, self.y, "font-weight=\"600\"", words)?;
        self.y += 22.0;
        Ok(())
    }

    pub fn words(&mut self, words: &str) -> Result {
        text(self.svg, self.x + 40.0, self.y + 4.5, QUIET, words)?;
        self.y += 22.0;
        Ok(())
    }

    pub fn stroke(&mut self, style: &str, words: &str) -> Result {
        line(self.svg, (self.x, self.y), (self.x + 30.0, self.y), style)?;
        self.words(words)
    }

    pub fn area(&mut self, colour: &str, words: &str) -> Result {
        let (x, y) = (self.x, self.y - 6.0);
        writeln!(self.svg, "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"30\" height=\"12\" fill=\"{colour}\"/>")?;
        self.words(words)
    }

    pub fn mark(&mut self, colour: &str, told: bool, filled: bool, words: &str) -> Result {
        mark(self.svg, (self.x + 15.0, self.y), colour, told, filled)?;
        self.words(words)
    }
}

/// A disc for what was measured, a square for what was told.
pub(super) fn mark(svg: &mut String, (x, y): (f64, f64), colour: &str, told: bool, filled: bool) -> Result {
    let fill = if filled { colour } else { "#ffffff" };
    let style = format!("fill=\"{fill}\" stroke=\"{colour}\" stroke-width=\"1.4\"");
    if told {
        let (left, top) = (x - 4.0, y - 4.0);
        return writeln!(svg, "<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"8\" height=\"8\" {style}/>");
    }
    writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" {style}/>")
}
