//! A scan file as a stream of blocks: one is hashed on another core while this one decodes it and reads the next.

use std::io::Read;

use sha2::digest::Output;
use sha2::{Digest, Sha256};

use super::CloudError;

/// Bytes per block: some hundred microseconds of work.
pub(super) const BLOCK: usize = 1 << 20;
/// Bytes at the beginning in which a format is told and a PLY header must end (or be refused).
const HEAD: usize = (1 << 20) + 2;

/// Where a scan's bytes come from.
pub(super) struct Source<'a, R> {
    /// The file's name, for errors.
    pub file: &'a str,
    reader: R,
    size: u64,
    most: u64,
    read: u64,
}

impl<'a, R: Read> Source<'a, R> {
    /// `size` is what the file is said to have: 0 for a pipe, and it may change. More than `most` is refused.
    pub fn new(file: &'a str, reader: R, size: u64, most: u64) -> Source<'a, R> {
        Source { file, reader, size, most, read: 0 }
    }

    /// The first bytes; all of a small file.
    pub fn head(&mut self) -> Result<Vec<u8>, CloudError> {
        let mut head = Vec::new();
        self.fill(&mut head, HEAD)?;
        Ok(head)
    }

    /// The whole file, given its head.
    pub fn rest(&mut self, mut head: Vec<u8>) -> Result<Vec<u8>, CloudError> {
        head.reserve_exact(self.left() as usize);
        let most = usize::try_from(self.most + 1).unwrap_or(usize::MAX);
        self.fill(&mut head, most.saturating_sub(self.read as usize))?;
        Ok(head)
    }

    /// Bytes that are said to follow.
    pub fn left(&self) -> u64 {
        self.size.saturating_sub(self.read)
    }

    /// Appends the next `n` bytes, fewer only at the end of the file. Returns how many.
    fn fill(&mut self, out: &mut Vec<u8>, n: usize) -> Result<usize, CloudError> {
        let failed = |reason| CloudError::Read { file: self.file.to_owned(), reason };
        let got = (&mut self.reader).take(n as u64).read_to_end(out).map_err(failed)?;
        self.read += got as u64;
        if self.read > self.most {
            let bytes = self.read.max(self.size);
            return Err(CloudError::TooLarge { file: self.file.to_owned(), bytes, allowed: self.most });
        }
        Ok(got)
    }

    /// Passes the whole file, `block` bytes at a time, through `decode`, which is given bytes and returns how many
    /// it used up; the others come again before the next. Bytes before `data` of the head are only hashed.
    pub fn pass(
        &mut self,
        head: &[u8],
        data: usize,
        block: usize,
        mut decode: impl FnMut(&[u8]) -> usize,
    ) -> Result<Output<Sha256>, CloudError> {
        let mut hasher = Sha256::new();
        hasher.update(head);
        let mut current = Vec::with_capacity(2 * block);
        let used = decode(&head[data..]);
        let mut kept = head.len() - data - used;
        current.extend_from_slice(&head[data + used..]);
        self.fill(&mut current, block)?;
        let mut next = Vec::with_capacity(2 * block);
        while current.len() > kept {
            // Reading stays on the caller's thread: a slow pipe must not hold up the pool.
            let got = rayon::in_place_scope(|scope| {
                scope.spawn(|_| hasher.update(&current[kept..]));
                let used = decode(&current);
                next.clear();
                next.extend_from_slice(&current[used..]);
                let kept = next.len();
                self.fill(&mut next, block).map(|_| kept)
            });
            kept = got?;
            std::mem::swap(&mut current, &mut next);
        }
        Ok(hasher.finalize())
    }
}
