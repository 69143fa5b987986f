//! Files that are whole or not there: what a run writes is either the old content or the new, whatever stops the
//! program and whenever.
//!
//! The bytes go to a temporary file beside the target, `.NAME.PROCESS.NUMBER.tmp`, are synchronised to the disk and
//! renamed onto it. A write that fails removes its temporary file; a process that is killed cannot, so the next run in
//! the folder calls [`remove_leftovers`].
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Makes the temporary names of one process distinct.
static TEMPORARY: AtomicU64 = AtomicU64::new(0);

/// Why a file could not be written.
#[derive(Debug)]
pub struct WriteFailure {
    /// What was being done, to follow "could not".
    pub action: &'static str,
    /// The operating system's answer.
    pub source: std::io::Error,
}

/// Writes `bytes` to `path`: the old file or the new one, never a part of either.
///
/// A link is followed: what it points to is replaced and not the link. Something that is neither file nor folder (a
/// device, a pipe, `/dev/stdout`) is written to directly, since renaming onto it would put a file in its place.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), WriteFailure> {
    write_whole_with(path, |file| file.write_all(bytes))
}

/// [`write_whole`] of what `write` writes, for files that are made piece by piece.
pub fn write_whole_with(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), WriteFailure> {
    let fail = |action| move |source| WriteFailure { action, source };
    if std::fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        let mut device = std::fs::OpenOptions::new().write(true).open(path).map_err(fail("write"))?;
        return write(&mut device).and_then(|()| device.flush()).map_err(fail("write"));
    }
    let target = match path.is_symlink() {
        true => path.canonicalize().unwrap_or_else(|_| path.to_owned()),
        false => path.to_owned(),
    };
    let Some(name) = target.file_name() else {
        return Err(fail("write a file without a name")(std::io::ErrorKind::InvalidInput.into()));
    };
    let number = TEMPORARY.fetch_add(1, Ordering::Relaxed);
    let mut temporary = std::ffi::OsString::from(".");
    temporary.push(name);
    temporary.push(format!(".{}.{number}.tmp", std::process::id()));
    let temporary = target.with_file_name(temporary);
    let written = replace(&temporary, &target, write);
    if written.is_err() {
        // Gives the space back; that the removal may fail as well changes nothing.
        let _ = std::fs::remove_file(&temporary);
        return written;
    }
    // The rename itself survives a crash only once the folder is on disk; not every system can do that.
    if let Some(folder) = target.parent() {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let _ = std::fs::File::open(folder).and_then(|folder| folder.sync_all());
    }
    Ok(())
}

fn replace(
    temporary: &Path,
    target: &Path,
    write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), WriteFailure> {
    let fail = |action| move |source| WriteFailure { action, source };
    let mut file = std::fs::File::create(temporary).map_err(fail("create a temporary file beside it"))?;
    write(&mut file).map_err(fail("write"))?;
    file.sync_all().map_err(fail("sync"))?;
    drop(file);
    std::fs::rename(temporary, target).map_err(fail("rename the temporary file onto it"))
}

/// Removes from `folder` the temporary files of processes that were killed while they wrote, and returns which. Those of
/// processes that still run stay, where the system says which do. A folder that is not there holds none.
pub fn remove_leftovers(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut removed: Vec<PathBuf> = entries
        .flatten()
        .filter(|entry| writer_of(&entry.file_name().to_string_lossy()).is_some_and(|process| !runs(process)))
        .map(|entry| entry.path())
        .filter(|path| std::fs::remove_file(path).is_ok())
        .collect();
    removed.sort();
    removed
}

/// The process in the name of a temporary file.
fn writer_of(name: &str) -> Option<u32> {
    let mut parts = name.strip_prefix('.')?.strip_suffix(".tmp")?.rsplitn(3, '.');
    let number = parts.next()?;
    let process = parts.next()?;
    parts.next().filter(|target| !target.is_empty())?;
    number.parse::<u64>().ok()?;
    process.parse().ok()
}

/// Whether a process other than this one runs; `false` where that is not known.
fn runs(process: u32) -> bool {
    process != std::process::id() && Path::new("/proc").join(process.to_string()).exists()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("diamond-whole-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        path
    }

    #[test]
    fn what_fails_leaves_the_old_file_and_no_debris() {
        let dir = folder("fails");
        let path = dir.join("a.json");
        write_whole(&path, b"old").unwrap();
        write_whole(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        // A folder cannot be replaced by a file: the rename fails after the bytes were written.
        std::fs::create_dir_all(dir.join("b/inside")).unwrap();
        assert!(write_whole(&dir.join("b"), b"x").unwrap_err().action.contains("rename"));
        assert!(write_whole(&path.join("c"), b"x").unwrap_err().action.contains("create"));
        assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 2);
        std::fs::remove_dir_all(dir).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_devices_are_not_replaced() {
        let dir = folder("links");
        std::fs::write(dir.join("target"), "old").unwrap();
        std::os::unix::fs::symlink(dir.join("target"), dir.join("link")).unwrap();
        write_whole(&dir.join("link"), b"new").unwrap();
        assert!(dir.join("link").is_symlink());
        assert_eq!(std::fs::read(dir.join("target")).unwrap(), b"new");
        // Through a link of our own, so that a mistake would not harm the machine.
        std::os::unix::fs::symlink("/dev/null", dir.join("null")).unwrap();
        write_whole(&dir.join("null"), b"gone").unwrap();
        assert!(dir.join("null").is_symlink() && !Path::new("/dev/null").is_file());
        assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 3);
        std::fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn leftovers_of_the_dead_are_removed_and_nothing_else() {
        let dir = folder("leftovers");
        // No system has a process of this number.
        let dead = format!(".model.ply.{}.0.tmp", u32::MAX);
        let keep = ["notes.tmp", ".hidden", ".a.b.tmp", "model.ply", ".1.2.tmp"];
        keep.iter().chain([&dead.as_str()]).for_each(|name| std::fs::write(dir.join(name), "x").unwrap());
        assert_eq!(remove_leftovers(&dir), [dir.join(&dead)]);
        assert_eq!(std::fs::read_dir(&dir).unwrap().count(), keep.len());
        assert!(remove_leftovers(&dir.join("nowhere")).is_empty());
        if Path::new("/proc/1").exists() {
            std::fs::write(dir.join(".model.ply.1.0.tmp"), "x").unwrap();
            assert!(remove_leftovers(&dir).is_empty(), "process 1 always runs");
        }
        std::fs::remove_dir_all(dir).unwrap();
    }
}
