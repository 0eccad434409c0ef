// The log of a job, as it grows.

import { useEffect, useRef, useState } from "preact/hooks";

import { get } from "../api";
import type { LogPiece } from "../types";

const KEPT_CHARACTERS = 400_000;
const FIRST_BYTES = 100_000;

/** size: how long the log is now, as far as the page knows; fetched from there on. */
export function Log({ job, size }: { job: string; size: number }) {
  const [text, setText] = useState("");
  const [follow, setFollow] = useState(true);
  const box = useRef<HTMLPreElement>(null);
  const line = useRef({ next: -FIRST_BYTES, wanted: 0, busy: false, stop: new AbortController() });
  useEffect(() => {
    const stop = new AbortController();
    line.current = { next: -FIRST_BYTES, wanted: 0, busy: false, stop };
    return () => { stop.abort(); };
  }, [job]);
  useEffect(() => {
    const { current } = line;
    current.wanted = size;
    // What fails is tried again when the log has grown.
    if (!current.busy) fetchMore(job, current, (more) => { setText((old) => (old + more).slice(-KEPT_CHARACTERS)); }).catch(() => undefined);
  }, [job, size]);
  useEffect(() => {
    if (follow && box.current !== null) box.current.scrollTop = box.current.scrollHeight;
  }, [text, follow]);
  return (
    <>
      <pre
        ref={box} class="log" tabIndex={0} role="log" aria-label="Log" aria-live="off"
        onScroll={(event) => {
          const { scrollTop, scrollHeight, clientHeight } = event.currentTarget;
          setFollow(scrollHeight - scrollTop - clientHeight < 40);
        }}
      >{text === "" ? "Nothing yet." : text}</pre>
      <label class="check small"><input type="checkbox" checked={follow} onChange={(event) => { setFollow(event.currentTarget.checked); }} /> Follow the end</label>
    </>
  );
}

interface Line {
  /** Where to read on; negative: from the end. */
  next: number;
  wanted: number;
  busy: boolean;
  readonly stop: AbortController;
}

/** Reads on until what is wanted is there, also what became wanted meanwhile. */
async function fetchMore(job: string, line: Line, take: (text: string) => void): Promise<void> {
  line.busy = true;
  try {
    while (line.next < line.wanted) {
      const piece = await get<LogPiece>(`/v1/jobs/${job}/logs?from=${String(line.next)}`, line.stop.signal);
      if (line.stop.signal.aborted || piece.text === "") return;
      line.next = piece.next;
      take(piece.text);
    }
  } finally {
    line.busy = false;
  }
}
