//! How much memory the process has needed.

/// Largest resident size of this process so far, bytes; `None` where the system does not tell (only Linux does here).
pub fn peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kilobytes| kilobytes * 1024)
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
