"""Definitions of the metrics of detections, in words, for reports and JSON files."""

METRIC_DEFINITIONS = {
    "error": "label minus detection; an image with N labels inside the image has its N most "
    "confident detections matched to them one-to-one with the least total distance",
    "median_px": "median length of the pixel error; a label without a detection is infinitely far",
    "mean_px": "mean length of the pixel error, over labels with a detection",
    "rmse_px": "root mean square length of the pixel error, over labels with a detection",
    "p95_px": "95th percentile of the length of the pixel error",
    "within_8_px": "share of labels with an error of at most 8 px",
    "within_20_px": "share of labels with an error of at most 20 px",
    "bias_u_px": "median error in u, label minus detection",
    "bias_v_px": "median error in v, label minus detection",
    "depth_mae_m": "mean absolute depth error, over labels with a detection",
    "depth_rmse_m": "root mean square depth error, over labels with a detection",
    "r2_u": "share of the variance of u that is explained, R2, over labels with a detection",
    "r2_v": "the same of v",
    "r2_depth": "the same of the depth",
    "precision": "share of detections at or above the threshold that are right: in order of "
    "confidence each takes the nearest free label within 16 px",
    "recall": "share of labels taken by a detection at or above the threshold",
    "f1": "harmonic mean of precision and recall",
    "ap_8_px": "area under the precision envelope over recall, detections right within 8 px",
    "ap_16_px": "the same within 16 px",
    "band": "by the label's depth; a detection without a label counts by its own depth",
    "interval": "95 % percentile bootstrap over images",
}
