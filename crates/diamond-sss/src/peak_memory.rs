//! How much memory the process has needed.
use serde::Serialize;

/// Largest resident size of this process so far, bytes; `None` where the system does not tell (only Linux does here).
pub fn peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kilobytes| kilobytes * 1024)
}

/// The high-water mark after each part of a run: where it rose says which part needed most.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct PeakAfter(Vec<(&'static str, u64)>);

impl PeakAfter {
    /// Notes the mark at the end of `part`; nothing where the system does not tell it.
    pub fn note(&mut self, part: &'static str) {
        self.0.extend(peak_bytes().map(|bytes| (part, bytes)));
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn linux_tells() {
        if cfg!(target_os = "linux") {
            assert!(super::peak_bytes().unwrap() > 1 << 16);
        }
    }
}
