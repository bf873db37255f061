//! Atomic file replacement: after a crash, a kill or a full disk the path holds the old content or the new one, never a
//! part of either.
//!
//! The bytes go to a temporary file in the same folder, are synchronised to the disk, renamed over the target, and then
//! the folder itself is synchronised so that the new name survives a power loss.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Beginning of the name of every temporary file; see [`remove_leftovers`].
const TEMP_PREFIX: &str = ".gadm-";
/// End of the name of every temporary file.
const TEMP_SUFFIX: &str = ".tmp";

/// A file could not be replaced. The target is as it was before, except for [`Step::SyncFolder`] (see there).
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {step} failed: {source}; {}", path.display(), advice(source, path))]
pub struct AtomicWriteError {
    /// The file that was to be written.
    pub path: PathBuf,
    /// The step that failed.
    pub step: Step,
    /// What the operating system said.
    #[source]
    pub source: io::Error,
}

/// The steps of an atomic write, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Making the temporary file beside the target.
    CreateTemporary,
    /// Writing the content into it.
    Write,
    /// Bringing its content to the disk.
    SyncFile,
    /// Renaming it over the target.
    Rename,
    /// Bringing the folder's entry to the disk. The target already has its new content when this fails, but a power loss
    /// may still undo it.
    SyncFolder,
}

impl std::fmt::Display for Step {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::CreateTemporary => "creating a temporary file in its folder",
            Self::Write => "writing the content",
            Self::SyncFile => "bringing the content to the disk",
            Self::Rename => "renaming the temporary file",
            Self::SyncFolder => "bringing the folder entry to the disk",
        })
    }
}

/// What the user can do about `source`.
fn advice(source: &io::Error, path: &Path) -> String {
    let folder = folder_of(path).display();
    match source.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            format!("free space on the disk that holds {folder} or choose another folder, then repeat the command")
        }
        io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
            format!("make {folder} writable for this user or choose another folder")
        }
        io::ErrorKind::NotFound => format!("create the folder {folder} first"),
        io::ErrorKind::NotADirectory | io::ErrorKind::AlreadyExists => {
            format!("{folder} or one of its parents is a file, not a folder: choose another path")
        }
        io::ErrorKind::IsADirectory | io::ErrorKind::DirectoryNotEmpty => {
            "a folder has this name: choose another name".to_owned()
        }
        _ => format!("check the disk that holds {folder}"),
    }
}

/// The folder that holds `path`; `.` for a bare file name.
fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// Replaces the file at `path` by `bytes`.
///
/// # Errors
/// [`AtomicWriteError`] with the failed step and its cause; the old file, if any, is untouched.
///
/// # Examples
/// ```
/// # let folder = tempfile::tempdir()?;
/// let path = folder.path().join("card.toml");
/// gadm_trainer::atomic::write(&path, b"latents = 16\n")?;
/// assert_eq!(std::fs::read(&path)?, b"latents = 16\n");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), AtomicWriteError> {
    write_with(path, |file| file.write_all(bytes))
}

/// Replaces the file at `path` by what `fill` writes; for content too large to hold in memory twice.
///
/// # Errors
/// As [`write()`]; an error that `fill` returns is reported as [`Step::Write`].
pub fn write_with<F>(path: &Path, fill: F) -> Result<(), AtomicWriteError>
where
    F: FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
{
    let failed = |step: Step| move |source: io::Error| AtomicWriteError { path: path.to_path_buf(), step, source };
    let folder = folder_of(path);
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMP_PREFIX).suffix(TEMP_SUFFIX);
    // The default of `tempfile` is readable by the owner only; a result is a normal file under the user's umask.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut temporary = builder.tempfile_in(folder).map_err(failed(Step::CreateTemporary))?;

    let mut buffer = BufWriter::new(temporary.as_file_mut());
    fill(&mut buffer).and_then(|()| buffer.flush()).map_err(failed(Step::Write))?;
    drop(buffer);
    temporary.as_file().sync_all().map_err(failed(Step::SyncFile))?;
    temporary.persist(path).map_err(|error| failed(Step::Rename)(error.error))?;
    sync_folder(folder).map_err(failed(Step::SyncFolder))
}

#[cfg(unix)]
fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Folders cannot be opened as files there; the rename itself is all the system offers.
#[cfg(not(unix))]
#[allow(clippy::unnecessary_wraps, reason = "same signature as on Unix")]
fn sync_folder(_folder: &Path) -> io::Result<()> {
    Ok(())
}

/// Removes temporary files that a killed process left in `folder` and says how many there were. To be called where no
/// other process writes into the folder, such as at the start of a resumed run.
///
/// # Errors
/// The error of reading the folder or of removing a file.
pub fn remove_leftovers(folder: &Path) -> io::Result<usize> {
    let mut removed = 0;
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if is_leftover(&entry.file_name()) && entry.file_type()?.is_file() {
            std::fs::remove_file(entry.path())?;
            removed += 1;
        }
    }
    Ok(removed)
}

fn is_leftover(name: &OsStr) -> bool {
    name.to_str().is_some_and(|name| name.starts_with(TEMP_PREFIX) && name.ends_with(TEMP_SUFFIX))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn replaces_the_content_and_leaves_no_temporary_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("policy.bin");
        write(&path, b"first, and longer").unwrap();
        write(&path, b"second").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"second");
        assert_eq!(names(folder.path()), ["policy.bin"]);
    }

    #[cfg(unix)]
    #[test]
    fn the_file_has_the_permissions_of_a_plainly_created_one() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let (plain, atomic) = (folder.path().join("plain"), folder.path().join("atomic"));
        std::fs::write(&plain, b"x").unwrap();
        write(&atomic, b"x").unwrap();
        let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&atomic), mode(&plain));
    }

    #[test]
    fn a_failure_halfway_keeps_the_old_content() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.bin");
        write(&path, b"old").unwrap();
        let error = write_with(&path, |file| {
            file.write_all(b"half of the new")?;
            Err(io::Error::other("interrupted"))
        })
        .unwrap_err();
        assert_eq!(error.step, Step::Write);
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["checkpoint.bin"]);
    }

    /// `/dev/full` answers every write with the error of a full disk.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_named_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.bin");
        write(&path, b"old").unwrap();
        let error = write_with(&path, |file| {
            file.write_all(b"new")?;
            std::fs::OpenOptions::new().write(true).open("/dev/full")?.write_all(b"x")
        })
        .unwrap_err();
        assert_eq!(error.source.kind(), io::ErrorKind::StorageFull);
        let text = error.to_string();
        assert!(text.contains("checkpoint.bin") && text.contains("free space"), "{text}");
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["checkpoint.bin"]);
    }

    #[test]
    fn a_parent_that_is_a_file_is_said() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("run"), b"").unwrap();
        let error = write(&folder.path().join("run/policy.bin"), b"x").unwrap_err();
        assert_eq!(error.step, Step::CreateTemporary);
        assert!(error.to_string().contains("is a file, not a folder"), "{error}");
    }

    #[test]
    fn a_missing_folder_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let error = write(&folder.path().join("absent/policy.bin"), b"x").unwrap_err();
        assert!(error.to_string().contains("create the folder"), "{error}");
    }

    #[test]
    fn a_folder_at_the_target_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("policy.bin")).unwrap();
        let error = write(&folder.path().join("policy.bin"), b"x").unwrap_err();
        assert_eq!(error.step, Step::Rename);
        assert_eq!(names(folder.path()), ["policy.bin"]);
    }

    /// The superuser may write anywhere, so the folder's mode is tested by what a plain write does in it.
    #[cfg(unix)]
    #[test]
    fn a_folder_without_write_permission_is_refused_unless_the_user_may_write_anywhere() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o555)).unwrap();
        let plain = std::fs::write(folder.path().join("plain"), b"x");
        let atomic = write(&folder.path().join("atomic"), b"x");
        assert_eq!(plain.is_ok(), atomic.is_ok());
        if let Err(error) = atomic {
            assert_eq!(error.source.kind(), io::ErrorKind::PermissionDenied);
            assert!(error.to_string().contains("writable"), "{error}");
        }
        std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o755)).unwrap();
    }

    #[test]
    fn advice_for_a_denied_permission_names_the_folder() {
        let error = AtomicWriteError {
            path: PathBuf::from("runs/a/policy.bin"),
            step: Step::CreateTemporary,
            source: io::ErrorKind::PermissionDenied.into(),
        };
        assert!(error.to_string().contains("make runs/a writable"), "{error}");
    }

    #[test]
    fn leftovers_of_a_killed_process_are_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        for name in [".gadm-Ab12.tmp", "policy.bin", "mine.tmp", ".gadm-notes"] {
            std::fs::write(folder.path().join(name), b"x").unwrap();
        }
        assert_eq!(remove_leftovers(folder.path()).unwrap(), 1);
        assert_eq!(names(folder.path()), [".gadm-notes", "mine.tmp", "policy.bin"]);
    }
}
