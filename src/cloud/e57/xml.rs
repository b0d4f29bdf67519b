//! What the XML part of an E57 file may be like before it is parsed.
//!
//! Its parser compares every attribute of a tag with all others, and copies the namespaces in force for every tag that adds
//! one: a file of a few megabytes could keep it busy for hours or fill the memory. A real one has short tags and a
//! handful of namespaces.

use memchr::memchr;
use memchr::memmem::find;

/// Bytes of the whole, enough for some thousand scans.
const LONGEST: usize = 4 << 20;
/// Bytes of one tag.
const LONGEST_TAG: usize = 4096;
/// Namespaces of the whole.
const MOST_NAMESPACES: usize = 64;

/// Refuses what would take the parser too long.
pub(super) fn check(xml: &[u8]) -> Result<(), String> {
    if xml.len() > LONGEST {
        return Err(format!("its XML part has {} bytes, at most {LONGEST} are read", xml.len()));
    }
    let (mut at, mut namespaces) = (0, 0);
    while let Some(next) = memchr(b'<', &xml[at..]) {
        at += next;
        let rest = &xml[at..];
        // Here names and quotes mean nothing.
        let other = [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>")];
        let long = other.iter().find(|(begin, _)| rest.starts_with(begin.as_bytes()));
        at += match long {
            Some((_, end)) => find(rest, end.as_bytes()).map_or(rest.len(), |n| n + end.len()),
            None => {
                let tag = tag(rest).ok_or_else(|| {
                    format!("a tag of its XML part, at byte {at}, does not end within {LONGEST_TAG} bytes")
                })?;
                namespaces += usize::from(find(tag, b"xmlns").is_some());
                tag.len()
            }
        };
        if namespaces > MOST_NAMESPACES {
            return Err(format!("its XML part names more than {MOST_NAMESPACES} namespaces"));
        }
    }
    Ok(())
}

/// The tag at the beginning of a text; None when it is too long. In quotes > does not end it.
fn tag(text: &[u8]) -> Option<&[u8]> {
    let mut quote = None;
    for (i, &byte) in text.iter().enumerate().take(LONGEST_TAG) {
        match (quote, byte) {
            (None, b'>') => return Some(&text[..=i]),
            (None, b'"' | b'\'') => quote = Some(byte),
            (Some(open), _) if open == byte => quote = None,
            _ => {}
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn usual_parts_pass_and_those_that_take_long_do_not() {
        let usual = "<?xml version='1.0' don't?><!-- <a \" --><e57Root xmlns='x'><a b='>'/><![CDATA[<' ]]>1 > 0</e57Root>";
        assert_eq!(check(usual.as_bytes()), Ok(()));
        let refused = |xml: String, why: &str| assert!(check(xml.as_bytes()).unwrap_err().contains(why));
        let many = |n: usize, one: fn(usize) -> String| (0..n).map(one).collect::<String>();
        refused(format!("<a {}/>", many(1000, |i| format!(" a{i}='>'"))), "does not end");
        refused(many(65, |i| format!("<a xmlns:b{i}='c'>")), "65 namespaces".trim_start_matches("65 "));
        refused("<a".to_owned(), "does not end");
        refused(" ".repeat(LONGEST + 1), "at most 4194304");
    }
}
